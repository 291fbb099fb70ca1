"""Drivers: cameras, autopilots and recorded flights as stamped messages."""
