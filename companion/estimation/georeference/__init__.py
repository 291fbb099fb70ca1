"""Georeference of maps: scale, heading and place from the autopilot's sensors, map by map."""
