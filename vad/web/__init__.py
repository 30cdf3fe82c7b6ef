"""A page for browsers on the hub: the floor plan, its devices, and how everything is."""
