"""Images from files, their times and metadata, and camera calibration files."""
