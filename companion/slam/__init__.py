"""Monocular visual SLAM. Pure: no I/O, no clock, no event loop."""
