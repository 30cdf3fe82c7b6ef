"""Who joined the Wi-Fi network."""
