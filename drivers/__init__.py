"""The edge towards cameras, autopilots and recorded flights: everything becomes stamped messages."""
