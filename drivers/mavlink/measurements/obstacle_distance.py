"""Obstacles as OBSTACLE_DISTANCE, by the vehicle's heading, and as OBSTACLE_DISTANCE_3D."""

from __future__ import annotations

from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.geometry.transforms import Array
from companion.obstacles.obstacle_sectors import MAX_M, MIN_M, SECTOR_DEG, Obstacles, unknown

NO_ID = 65535
"""Obstacles are not followed from one round to the next."""


def obstacle_messages(found: Obstacles | Array | None, t_ns: int, in_space: bool) -> list[Any]:
    """Messages of a round: of obstacles per sector, or points (N, 3), body axes; None: unknown."""
    if in_space:
        points = found if isinstance(found, np.ndarray) else np.zeros((0, 3))
        return obstacles_3d(points, t_ns)
    return [obstacle_distance(found if isinstance(found, Obstacles) else unknown(t_ns))]


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


def obstacles_3d(points_body_m: Array, t_ns: int) -> list[Any]:
    """One message for each obstacle (N, 3), and a last one, which holds none.

    ArduPilot takes messages of one time for one round, and counts them once another time comes:
    so the last one, whose distance of 0 it takes for no obstacle, is a millisecond later. It also
    tells that nothing is there.
    """
    t_ms = t_ns // 1_000_000 & 0xFFFFFFFF
    return [
        mavlink.MAVLink_obstacle_distance_3d_message(
            time_boot_ms=(t_ms + late_ms) & 0xFFFFFFFF,
            sensor_type=mavlink.MAV_DISTANCE_SENSOR_UNKNOWN,
            frame=mavlink.MAV_FRAME_BODY_FRD,
            obstacle_id=NO_ID,
            x=float(x), y=float(y), z=float(z),
            min_distance=MIN_M, max_distance=MAX_M,
        )
        for late_ms, points in ((0, points_body_m), (1, np.zeros((1, 3))))
        for x, y, z in points
    ]  # fmt: skip
