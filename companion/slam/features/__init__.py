"""ORB features, matching, KLT tracking, patch alignment, triangulation. Knows no map."""
