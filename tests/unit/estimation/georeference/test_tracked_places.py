"""Frames move with their keyframes, whichever map these are in."""

from __future__ import annotations

import numpy as np

from companion.estimation.georeference.tracked_places import (
    HOVER_NS,
    MAX_PLACES,
    TrackedPlaces,
)
from companion.geometry.pose_table import PoseTable
from companion.geometry.transforms import Pose, rotation_from_vector

MOUNT = rotation_from_vector(np.array([0.1, 0.7, 1.2]))
STEP_NS = 100_000_000
TURN = rotation_from_vector(np.array([0.2, -0.1, 0.4]))


def _inside(n: int) -> Pose:
    return Pose(rotation_from_vector(np.array([0.0, 0.0, 0.01 * n])), np.array([0.1 * n, 1.0, 2.0]))


def _kept(n: int) -> TrackedPlaces:
    """Frames of keyframe 7 and 3, in turns."""
    kept = TrackedPlaces()
    for i in range(n):
        kept.add(i * STEP_NS, 7 if i % 2 == 0 else 3, _inside(i), np.eye(3))
    return kept


def test_frames_are_where_their_keyframe_is_now() -> None:
    table = PoseTable.of({7: Pose(TURN, np.array([5.0, 0.0, 0.0]))})
    found = _kept(9).of(table, {7: 2.0}, MOUNT, STEP_NS, 8 * STEP_NS)
    assert found.t_ns.tolist() == [2 * STEP_NS, 4 * STEP_NS, 6 * STEP_NS]
    for n, rotation, place in zip((2, 4, 6), found.rotations, found.places, strict=True):
        inside = _inside(n)
        np.testing.assert_allclose(rotation, TURN @ inside.rotation, atol=1e-12)
        expected = TURN @ (2.0 * inside.translation) + [5.0, 0.0, 0.0]
        np.testing.assert_allclose(place, expected, atol=1e-12)
    np.testing.assert_allclose(found.ned_from_camera, np.tile(MOUNT, (3, 1, 1)), atol=1e-12)


def test_frames_come_in_order_of_time_and_not_too_close() -> None:
    kept, pose = TrackedPlaces(), Pose.identity()
    for t_ns in (500, 1500, 700):  # milliseconds; the last was localised afterwards
        kept.add(t_ns * 1_000_000, 1, pose, np.eye(3))
    kept.add(710 * 1_000_000, 1, pose, np.eye(3))
    found = kept.of(PoseTable.of({1: pose}), {}, np.eye(3), 0, 2_000_000_000)
    assert (found.t_ns // 1_000_000).tolist() == [500, 700, 1500]


def test_their_number_is_bounded() -> None:
    kept = _kept(2 * MAX_PLACES + 5)
    table = PoseTable.of({7: Pose.identity(), 3: Pose.identity()})
    found = kept.of(table, {}, np.eye(3), 0, 2**62)
    assert MAX_PLACES // 2 <= len(found.t_ns) <= MAX_PLACES
    assert found.t_ns[-1] == (2 * MAX_PLACES + 4) * STEP_NS


def test_a_hover_does_not_count() -> None:
    """Nor does it push what was flown before it out of a time that frames are to last."""
    kept, pose, flown_ns = TrackedPlaces(), Pose.identity(), 20 * STEP_NS
    for t_ns in range(0, flown_ns, STEP_NS):
        kept.add(t_ns, 1 + t_ns // (5 * STEP_NS), pose, np.eye(3))
    for t_ns in range(flown_ns, flown_ns + 30 * HOVER_NS, STEP_NS):
        kept.add(t_ns, 9, pose, np.eye(3))
    hovered_ns = kept.newest_ns
    assert hovered_ns == flown_ns + HOVER_NS
    again_ns = flown_ns + 30 * HOVER_NS
    for t_ns in range(again_ns, again_ns + flown_ns, STEP_NS):
        kept.add(t_ns, 10, pose, np.eye(3))
    lasting_ns = flown_ns + 2 * STEP_NS
    assert kept.since_ns(again_ns + flown_ns, lasting_ns) == hovered_ns - 2 * STEP_NS
    assert kept.since_ns(again_ns + flown_ns, flown_ns - STEP_NS) == again_ns + STEP_NS
