"""The sparse map, extraction of parts of it, and projection of its points into a camera."""
