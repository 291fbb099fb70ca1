"""What an autopilot's parameters must be for it to fly on our pose, and which of them are not."""
