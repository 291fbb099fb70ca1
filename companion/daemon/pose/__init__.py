"""Poses on their way to the autopilot, and the reset counter that goes with them."""
