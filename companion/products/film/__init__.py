"""Film of a flight: path and cloud growing, beside the picture."""
