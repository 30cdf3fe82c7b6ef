"""Where the robot is, and the floor plan it made."""
