"""Images from files, their times and metadata, and the calibration file of a camera."""
