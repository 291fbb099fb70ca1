"""The first two keyframes of a map, or of its continuation after tracking was lost."""
