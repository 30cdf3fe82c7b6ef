"""The two stages: where the camera is, and where the Wi-Fi device is. Pure: arrays in, values out."""
