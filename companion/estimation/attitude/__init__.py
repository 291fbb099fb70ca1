"""The autopilot's attitude as that of the camera: mount, delay, verdicts on it and on maps."""
