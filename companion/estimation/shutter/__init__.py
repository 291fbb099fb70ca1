"""Rolling shutter: undone in images, and noticed where it is not known."""
