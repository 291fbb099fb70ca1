"""Where the camera is: features, tracking, mapping. Pure: no I/O, no clock, no event loop."""
