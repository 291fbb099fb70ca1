"""Trials against the firmwares themselves, in their simulators, with a camera that is drawn."""
