"""Drawings over the pilot's video are where they belong, and over a copy."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.camera import Camera
from companion.geometry.transforms import (
    Pose,
    quaternion_from_euler,
    rotation_from_quaternion,
)
from companion.messages import Bytes, DepthMap, Odometry, Track, TrackState
from companion.streaming.video_overlay import AMBER, GREEN, MAX_AGE_NS, VideoOverlay

FORWARD = Pose(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.zeros(3))
CAMERA = Camera(320, 240, 250.0, 250.0, 160.0, 120.0, body_from_camera=FORWARD)
PLAIN: Bytes = np.full((240, 320, 3), 30, np.uint8)


def odometry(roll_deg: float, pitch_deg: float, t_ns: int = 0) -> Odometry:
    turned = quaternion_from_euler(np.radians(roll_deg), np.radians(pitch_deg), 0.5)
    pose = Pose(rotation_from_quaternion(turned), np.zeros(3))
    return Odometry(0, t_ns, TrackState.TRACKING, 0, world_from_body=pose)


def rows_of(rgb: Bytes, column: int) -> float:
    rows = np.flatnonzero((rgb[:, column] == AMBER).all(1))
    assert len(rows)
    return float(rows.mean())


@pytest.mark.parametrize(("roll", "pitch"), [(0, 0), (0, 8), (0, -15), (20, 0), (-10, 5)])
def test_the_horizon_lies_where_the_world_is_level(roll: float, pitch: float) -> None:
    overlay = VideoOverlay(["horizon"], CAMERA)
    overlay.take(odometry(roll, pitch))
    drawn = overlay.drawn(PLAIN, 0)
    # with the nose up by some degrees it lies lower; rolled to the right it rises to the left
    down = 250 * np.tan(np.radians(pitch)) / np.cos(np.radians(roll))
    for column in (110, 160, 210):
        slope = (160 - column) * np.tan(np.radians(roll))
        assert rows_of(drawn, column) == pytest.approx(120 + down + slope, abs=2.5)


def test_tracked_points_are_marked_until_they_are_old() -> None:
    overlay = VideoOverlay(["points"], CAMERA)
    points = np.array([[50.0, 60.0], [200.0, 100.0]], np.float32)
    overlay.take(Track(0, 0, TrackState.TRACKING, keypoints_px=points))
    drawn = overlay.drawn(PLAIN, 1)
    for u, v in points.astype(int):
        assert (drawn[v - 2 : v + 3, u - 2 : u + 3] == GREEN).all(2).sum() == 16
    assert (PLAIN == 30).all()
    assert (overlay.drawn(PLAIN, MAX_AGE_NS) == PLAIN).all()


def test_depth_is_in_a_corner_near_red_and_far_blue() -> None:
    overlay = VideoOverlay(["depth"], CAMERA)
    depth = np.ones((24, 32), np.float32)
    depth[:, 16:] = 10.0
    none = np.zeros((24, 32), np.float32)
    overlay.take(DepthMap(
        0, 0, (25.0, 25.0, 16.0, 12.0), depth, none, none.astype(np.uint8), none,
        np.zeros((24, 32, 3), np.uint8), 1, {},
    ))  # fmt: skip
    drawn = overlay.drawn(PLAIN, 0).astype(int)
    near, far = drawn[200, 230], drawn[200, 300]
    assert near[0] > near[2] and far[2] > far[0]
    assert (drawn[:150] == 30).all()


def test_nothing_wanted_is_nothing_done() -> None:
    overlay = VideoOverlay([], CAMERA)
    overlay.take(odometry(0, 0))
    assert overlay.drawn(PLAIN, 0) is PLAIN
