"""Recorded flights in the formats of other people: data sets, ROS bags, stills, videos, folders."""
