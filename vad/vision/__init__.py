"""What a frame shows: people and where they stand, the robot. Pixels in, pixels and tracks out."""
