"""The edge towards cameras, autopilots and recorded flights: all becomes stamped messages."""
