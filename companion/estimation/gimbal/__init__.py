"""A camera on a gimbal: the head as the body of the estimation, and the body's pose out of it."""
