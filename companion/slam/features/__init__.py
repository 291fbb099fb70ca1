"""ORB features of a frame, their matching and tracking, triangulation. Knows no map."""
