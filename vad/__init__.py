"""vad, the Visual Assistant daemon: every Wi-Fi device of a home on the robot vacuum's floor plan."""

__version__ = "0.1.0"
