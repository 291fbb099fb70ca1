"""Two-view initialisation of a map, and continuation of one after tracking loss."""
