"""Replays of recorded flights: in order, paced, or as flown."""
