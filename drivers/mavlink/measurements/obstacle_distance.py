"""Obstacles as OBSTACLE_DISTANCE, in the frame of the vehicle's heading."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.dense.obstacles import SECTOR_DEG, Obstacles


def obstacle_distance(obstacles: Obstacles) -> Any:
    """The message; the first of its sectors is centred on forward, then clockwise."""
    return mavlink.MAVLink_obstacle_distance_message(
        time_usec=obstacles.t_ns // 1000,
        sensor_type=mavlink.MAV_DISTANCE_SENSOR_UNKNOWN,  # none of its kinds is a camera
        distances=[int(distance) for distance in obstacles.distances_cm],
        increment=round(SECTOR_DEG),
        min_distance=obstacles.min_cm,
        max_distance=obstacles.max_cm,
        increment_f=SECTOR_DEG,
        angle_offset=0.0,
        frame=mavlink.MAV_FRAME_BODY_FRD,
    )
