"""Frames with times."""
