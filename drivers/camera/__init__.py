"""Live cameras: one file per kind, one registry, one supervising thread."""
