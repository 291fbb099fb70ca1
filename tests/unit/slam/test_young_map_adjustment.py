"""Bundle adjustment puts right the two-view geometry that a map began with."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from companion.geometry.transforms import Pose, Similarity, angle_between, rotation_from_vector
from companion.slam.map.sparse_map import SlamMap
from companion.slam.mapping.mapper import Mapper
from companion.slam.mapping.mapping_worker import MapLock
from tests.support.reference.synthetic_map import CAMERA, Ground, flown, mapped

N = 5
WRONG_RAD = np.radians(2.0)


def second_turned() -> SlamMap:
    """A map of few keyframes, the second of which is turned."""
    ground = Ground(np.random.default_rng(3), n=2500)
    slam_map = mapped(
        ground, [flown(np.array([0.8 * k, 0.1 * k])) for k in range(N)], Similarity.identity()
    )
    second = slam_map.keyframes[1]
    turn = rotation_from_vector(np.array([0.0, WRONG_RAD, 0.0]))
    second.camera_from_map = Pose(turn @ second.camera_from_map.rotation,
                                  second.camera_from_map.translation)  # fmt: skip
    slam_map.keyframes_moved()
    return slam_map


@pytest.mark.parametrize(
    "adjust",
    [
        lambda mapper, newest: mapper.adjust_locally(newest),
        lambda mapper, newest: mapper.adjust_all(10),
    ],
    ids=["local", "global"],
)
def test_second_keyframe_of_a_young_map_is_adjusted(
    adjust: Callable[[Mapper, object], None],
) -> None:
    slam_map = second_turned()
    first, second = slam_map.keyframes[0], slam_map.keyframes[1]
    held = first.camera_from_map
    adjust(Mapper(CAMERA, slam_map, MapLock()), slam_map.keyframes[N - 1])
    assert first.camera_from_map is held
    off_rad = angle_between(second.camera_from_map.rotation, first.camera_from_map.rotation)
    assert off_rad < 0.2 * WRONG_RAD
    last = slam_map.keyframes[N - 1]
    assert np.linalg.norm(last.centre - first.centre) == pytest.approx(
        np.hypot(0.8, 0.1) * (N - 1), rel=0.02
    )
