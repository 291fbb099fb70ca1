"""The map of a site beyond its flight: made of a flight's map, and used by another flight."""
