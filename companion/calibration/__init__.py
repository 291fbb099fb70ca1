"""Lens calibration from views of a board: view and model selection, quality. Pure."""
