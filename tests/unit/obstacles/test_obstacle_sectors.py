"""Obstacles at known positions around rotated, tilted and displaced vehicles."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.geometry.transforms import (
    Array,
    Pose,
    quaternion_from_euler,
    rotation_from_quaternion,
)
from companion.obstacles.obstacle_sectors import N_SECTORS, UNKNOWN_CM, obstacles_around
from drivers.mavlink.measurements.obstacle_distance import obstacle_distance

PLACE = np.array([103.0, -57.0, -12.0])
FREE = 2001


def vehicle(yaw_deg: float, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> Pose:
    q = quaternion_from_euler(*np.radians([roll_deg, pitch_deg, yaw_deg]))
    return Pose(rotation_from_quaternion(q), PLACE)


def at(bearing_deg: float, distance_m: float, down_m: float = 0.0, n: int = 10) -> Array:
    """A small cluster of points at a true bearing from the vehicle, clockwise from north."""
    b = math.radians(bearing_deg)
    centre = PLACE + [distance_m * math.cos(b), distance_m * math.sin(b), down_m]
    offsets = np.linspace(-0.02, 0.02, n)
    out: Array = centre + offsets[:, None] * np.ones(3)
    return out


def distances(pose: Pose, points: Array, free: tuple[int, ...] = ()) -> dict[int, int]:
    """Sectors that are known."""
    is_free = np.isin(np.arange(N_SECTORS), free)
    found = obstacles_around(7, pose, points, is_free)
    assert found.distances_cm.shape == (72,)
    return {i: int(d) for i, d in enumerate(found.distances_cm) if d != UNKNOWN_CM}


def test_unseen_is_unknown_everywhere() -> None:
    assert distances(vehicle(30), np.zeros((0, 3))) == {}


@pytest.mark.parametrize(
    ("yaw_deg", "bearing_deg", "sector"),
    [
        (0, 0, 0),
        (0, 30, 6),
        (0, -30, 66),
        (0, 90, 18),  # east, to the right of one that looks north
        (90, 90, 0),
        (90, 0, 54),  # north, to the left of one that looks east
        (130, 170, 8),  # ahead and to the right
        (-170, 175, 69),  # across the seam
        (0, 2.3, 0),  # sectors are centred on their bearing
        (0, -2.3, 0),
        (0, 2.7, 1),
    ],
)
def test_sector_is_clockwise_from_the_heading(
    yaw_deg: float, bearing_deg: float, sector: int
) -> None:
    found = distances(vehicle(yaw_deg), at(bearing_deg, 8.0))
    assert list(found) == [sector]
    assert found[sector] == pytest.approx(800, abs=4)


def test_tilting_changes_neither_sector_nor_height() -> None:
    for pitch_deg, roll_deg in ((-25, 0), (0, 30), (20, -20)):
        found = distances(vehicle(130, pitch_deg, roll_deg), at(170, 15.0, 0.5))
        assert list(found) == [8]
        assert found[8] == pytest.approx(1500, abs=4)


def test_single_point_is_no_obstacle() -> None:
    points = np.concatenate([at(40, 12.0), at(40, 6.0), at(40, 3.0, n=2)])
    assert distances(vehicle(0), points) == {8: pytest.approx(600, abs=4)}


@pytest.mark.parametrize(
    ("down_m", "seen"), [(-0.9, True), (-1.2, False), (0.6, True), (0.9, False)]
)
def test_height_band(down_m: float, seen: bool) -> None:
    assert bool(distances(vehicle(0), at(40, 6.0, down_m))) is seen


def test_the_vehicle_itself_is_no_obstacle() -> None:
    assert distances(vehicle(0), at(40, 0.2)) == {}
    assert distances(vehicle(0), at(40, 0.4)) == {8: pytest.approx(40, abs=3)}


def test_an_obstacle_where_it_should_be_free() -> None:
    found = distances(vehicle(0), at(0, 10.0), free=(0, 1))
    assert found == {0: pytest.approx(1000, abs=4), 1: FREE}


def test_what_is_beyond_the_reach_is_not_told() -> None:
    points = np.concatenate([at(0, 7.0), at(40, 9.0)])
    is_free = np.isin(np.arange(N_SECTORS), 8)
    found = obstacles_around(7, vehicle(0), points, is_free, 8.0)
    assert found.max_cm == 800 and found.distances_cm[8] == 801
    assert found.distances_cm[0] == pytest.approx(700, abs=4)


def test_nan_points_are_ignored() -> None:
    points = at(40, 6.0)
    points[3] = np.nan
    points[4, 1] = np.inf
    assert distances(vehicle(0), points) == {8: pytest.approx(600, abs=4)}


def test_message_is_as_autopilots_read_it() -> None:
    is_free = np.isin(np.arange(N_SECTORS), 0)
    found = obstacles_around(1_790_000_000_123_456_789, vehicle(130), at(170, 8.0), is_free)
    link = mavlink.MAVLink(None, 1, 197)
    message = link.parse_buffer(obstacle_distance(found).pack(link))[0]
    assert message.get_type() == "OBSTACLE_DISTANCE"
    assert message.time_usec == 1_790_000_000_123_456
    assert (message.min_distance, message.max_distance) == (30, 2000)
    assert (message.increment, message.increment_f, message.angle_offset) == (5, 5.0, 0.0)
    assert message.frame == 12  # MAV_FRAME_BODY_FRD
    assert message.sensor_type == 4  # unknown
    assert message.distances[0] == 2001
    assert message.distances[8] == pytest.approx(800, abs=4)
    assert set(message.distances) == {2001, message.distances[8], 65535}
