"""Obstacles and free space around the vehicle now, by images, the map and its depths."""
