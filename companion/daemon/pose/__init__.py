"""Poses sent to the autopilot, and their reset counter."""
