"""Messages of what we measure for the autopilot: pose, flow, global position, marker, obstacles."""
