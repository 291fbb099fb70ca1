"""Smooth odometry of the body, in a frame of its own, for an autopilot to fly on."""
