"""Use of the autopilot's IMU: integrated, judged, for the scale of a map and dead reckoning."""
