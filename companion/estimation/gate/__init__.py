"""Pose gate: what of the odometry reaches the autopilot, with which reset counter, and why not."""
