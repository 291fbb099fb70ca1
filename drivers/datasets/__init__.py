"""Recorded flights in other formats: data sets, ROS bags, stills, videos, folders."""
