"""Body state from camera poses and autopilot measurements: scale, georeference, motion, pose gate.

Pure: no I/O, no clock, no event loop. Above `slam`, which knows the camera in its map only.
"""
