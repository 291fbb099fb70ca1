"""Motions that are difficult for a monocular camera."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose, rotation_from_vector, yaw_rotation
from tests.support.flights.rendered_flight import CAMERA_DOWN, Terrain, fly, white_between

CAMERA = Camera(320, 240, 260.0, 258.0, 161.0, 118.0, body_from_camera=CAMERA_DOWN)
BOTH = pytest.mark.parametrize("plane", [False, True], ids=["over roofs", "over flat ground"])


def eased(after_s: float, start_s: float, stop_s: float) -> float:
    """From 0 to 1, without a jolt."""
    share = float(np.clip((after_s - start_s) / (stop_s - start_s), 0.0, 1.0))
    return share * share * (3.0 - 2.0 * share)


def turning_at_take_off(after_s: float) -> Pose:
    """On the spot by 137 degrees in 4 s, then away."""
    gone = eased(after_s, 4.0, 8.0)
    turned = yaw_rotation(2.4 * eased(after_s, 0.0, 4.0))
    return Pose(turned, np.array([12.0 * gone, 0.0, -8.0 - 4.0 * gone]))


@BOTH
def test_a_turn_on_the_spot_begins_no_map_and_is_filled_in_later(plane: bool) -> None:
    flown = fly(CAMERA, turning_at_take_off, Terrain(3, plane), 8.0, 8.0)
    assert flown.keyframes_s[1] > 4.0
    assert flown.placed_share > 0.95
    errors = flown.errors()
    assert errors.ate_sim3_m < 0.35
    assert errors.scale_error < 0.04


def hovering(after_s: float) -> Pose:
    """Within decimetres of one place for 12 s, then 8 m to the north."""
    sway = np.array([0.1 * np.sin(0.7 * after_s), 0.1 * np.sin(0.9 * after_s), -12.0])
    turn = 0.01 * np.sin(np.array([1.1, 1.4, 0.6]) * after_s)
    return Pose(
        rotation_from_vector(turn), sway + np.array([8.0 * eased(after_s, 12.0, 15.0), 0, 0])
    )


def test_hovering_adds_nothing_and_loses_nothing() -> None:
    flown = fly(CAMERA, hovering, Terrain(3), 15.0, 4.0)
    while_there = [s for s in flown.keyframes_s if 4.0 < s < 12.0]
    assert len(while_there) <= 2
    assert flown.placed_share > 0.9
    assert flown.errors().ate_sim3_m < 0.2


def lawn_mower(after_s: float, speed_m_s: float = 4.0) -> Pose:
    """Three lines of 20 m, 5 m apart, always 15 m high, the nose to the north all the time."""
    corners = np.array([[-10, -5], [10, -5], [10, 0], [-10, 0], [-10, 5], [10, 5.0]])
    way = np.r_[0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))]
    flat = [np.interp(speed_m_s * after_s, way, corners[:, axis]) for axis in (0, 1)]
    turn = np.array([0.03 * np.sin(1.1 * after_s), 0.03 * np.sin(0.9 * after_s), 0.0])
    return Pose(rotation_from_vector(turn), np.array([*flat, -15.0]))


@pytest.mark.parametrize("told", [True, False], ids=["with telemetry", "vision alone"])
def test_a_survey_of_flat_ground_from_straight_above(told: bool) -> None:
    flown = fly(CAMERA, lawn_mower, Terrain(3, plane=True), 17.0, 5.0, told=told)
    assert flown.placed_share == 1.0 if told else flown.placed_share > 0.8
    assert flown.stage.n_segments == 1
    assert flown.errors().ate_sim3_m < (0.15 if told else 0.4)
    if told:
        assert flown.errors().scale_error < 0.01


def going_north(after_s: float) -> Pose:
    """At 5 m/s, 12 m high, rolling and pitching a little."""
    turn = 0.05 * np.sin(np.array([1.3, 1.7, 0.4]) * after_s)
    return Pose(rotation_from_vector(turn), np.array([5.0 * after_s - 20.0, 0.0, -12.0]))


def test_where_sight_returns_over_a_place_never_seen_the_map_goes_on_in_the_same_frame() -> None:
    flown = fly(CAMERA, going_north, Terrain(3), 8.5, 8.0, seen=white_between(3.5, 6.5))
    assert flown.stage.n_segments == 2
    due = [t_ns for t_ns in flown.frames_ns if not 3.5 <= (t_ns - flown.frames_ns[0]) * 1e-9 < 6.5]
    placed = {pose.t_ns for pose in flown.result.poses()}
    assert len(placed & set(due)) >= 0.95 * len(due)
    assert flown.live_errors().ate_sim3_m < 0.4, "42 m are flown, 15 of them blind"
    assert flown.errors().ate_sim3_m < 0.3


def agile(after_s: float) -> Pose:
    """Turning by up to 80 degrees a second, tilting by 20, all over a place of 20 m."""
    turn = np.array([0.28 * np.sin(1.6 * after_s), 0.25 * np.sin(1.3 * after_s + 0.7), 0.0])
    place = [9.0 * np.sin(0.55 * after_s), 8.0 * np.sin(0.4 * after_s + 0.3)]
    return Pose(
        yaw_rotation(1.6 * np.sin(0.9 * after_s)) @ rotation_from_vector(turn),
        np.array([*place, -12.0 - 2.0 * np.sin(0.7 * after_s)]),
    )


def test_an_agile_flight_relocalises_within_a_second_after_an_image_dropout() -> None:
    flown = fly(CAMERA, agile, Terrain(3), 10.0, 15.0, seen=white_between(5.0, 7.0))
    after_s = [(t_ns - flown.frames_ns[0]) * 1e-9 for t_ns in flown.frames_ns]
    known_s = {
        round((t.t_ns - flown.frames_ns[0]) * 1e-9, 6)
        for t in flown.tracks
        if t.map_from_camera is not None and not t.backfilled
    }
    begun_s = min(known_s)  # in a turn the map waits until its direction of motion is certain
    assert begun_s < 0.5
    due = [s for s in after_s if begun_s <= s < 5.0 or s >= 7.5]
    assert sum(round(s, 6) in known_s for s in due) >= 0.98 * len(due)
    assert min(s for s in known_s if s >= 7.0) < 7.5
    assert flown.live_errors().ate_sim3_m < 0.5, "the map goes on where it was"
    assert flown.errors().ate_sim3_m < 0.3
