"""Live video of the camera for pilots: RTSP."""
