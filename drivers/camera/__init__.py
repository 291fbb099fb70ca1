"""Live cameras: one file for each kind, one registry, one supervising thread."""
