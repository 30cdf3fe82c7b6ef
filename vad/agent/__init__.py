"""A remote Wi-Fi node with a CSI card: its stream to the hub, and the program that runs on it."""
