"""Checks of autopilot parameters for flight on our pose."""
