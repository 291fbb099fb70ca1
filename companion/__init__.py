"""Onboard flight companion: visual SLAM, dense metric mapping and a live map for drones."""

__version__ = "0.1.0"
