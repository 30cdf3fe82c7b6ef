"""Pictures and words about the map, for people."""
