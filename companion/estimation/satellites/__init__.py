"""Satellites against vision: whether a receiver's positions may place the map."""
