"""Answers to ground stations: commands, parameters, missions, and how many are taken."""
