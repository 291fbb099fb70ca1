"""Export formats: LAS, PCD, GeoTIFF, GPX, KML, GeoJSON, trajectory tables; and their accuracy."""
