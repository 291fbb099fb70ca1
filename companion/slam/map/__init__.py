"""The sparse map, its parts, and what of it a camera should see."""
