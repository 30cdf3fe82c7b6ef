"""The first run: what is plugged in and on the network here, and the settings file that follows from it."""
