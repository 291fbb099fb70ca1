"""The daemon: runs from power on to power off."""
