"""Precision landing: where a marker on the ground is, seen by the flight's own camera."""
