"""A climb without attitude, whose heading no position tells, beside a map that has one."""

from __future__ import annotations

import numpy as np
import pytest

from companion.config import GeoreferenceConfig
from companion.estimation.attitude.camera_attitude import CameraAttitude
from companion.estimation.georeference.georeferencer import Georeferencer
from companion.estimation.georeference.segment_georeference import SegmentGeoreferences
from companion.estimation.inertial.acceleration_integral import AccelerationIntegral
from companion.geometry.transforms import (
    Pose,
    Similarity,
    angle_between,
    rotation_from_vector,
    yaw_rotation,
)
from companion.slam.map.sparse_map import SlamMap
from companion.telemetry import PositionSample, PositionSource
from tests.support.reference.synthetic_map import Ground, flown, mapped

N_CLIMB, N_LEVEL, SPACING_S = 12, 40, 0.5
MAP_FROM_WORLD = Similarity(
    0.4, rotation_from_vector(np.array([0.5, -0.3, 1.9])), np.array([3.0, 1.0, -2.0])
)


def in_world(found_from: SegmentGeoreferences, segment: SlamMap) -> list[Pose] | None:
    """`world_from_camera` of the keyframes of a segment."""
    found = found_from.of(segment)
    if found is None:
        return None
    poses = [k.camera_from_map.inverse() for k in segment.keyframes.values()]
    return [found.world_from_map.apply_to_pose(pose) for pose in poses]


def flight(
    gap: int = 2, turn_rad_s: float = 0.0, tilt_rad: float = 0.0
) -> tuple[list[Pose], list[SlamMap], SegmentGeoreferences]:
    """True poses of a straight climb, its map and that of a curve after a gap, georeferenced.

    The gap is of so many keyframes more than usual; `turn_rad_s` turns the camera from its end on,
    `tilt_rad` tilts it within.
    """
    mount = Pose.identity()
    tilt = rotation_from_vector(np.array([tilt_rad, 0.0, 0.0]))
    climb = [
        Pose(tilt @ flown(np.zeros(2)).rotation, np.array([0.0, 0.0, -4.0 - k]))
        for k in range(N_CLIMB)
    ]
    first = N_CLIMB + gap
    turns = turn_rad_s * SPACING_S * np.arange(N_LEVEL)
    level = [
        Pose(yaw_rotation(turn) @ flown(np.zeros(2)).rotation, np.array([x, y, -14.0]))
        for turn, x, y in zip(
            turns, 10 * np.sin(np.arange(N_LEVEL) / 6), 0.5 * np.arange(N_LEVEL), strict=True
        )
    ]
    ground = Ground(np.random.default_rng(3))
    maps = [
        mapped(ground, climb, MAP_FROM_WORLD),
        mapped(ground, level, Similarity.identity(), first_id=first),
    ]
    georeferencer = Georeferencer(GeoreferenceConfig(), mount)
    t_s = [SPACING_S * k for k in [*range(N_CLIMB), *range(first, first + N_LEVEL)]]
    centres = np.stack([pose.translation for pose in [*climb, *level]])
    for t in np.arange(0.0, t_s[-1] + 0.1, 0.1):
        place = np.array([np.interp(t, t_s, centres[:, axis]) for axis in range(3)])
        georeferencer.take(PositionSample(int(t * 1e9), PositionSource.LOCAL, place, None))
    places = SegmentGeoreferences(
        georeferencer, CameraAttitude(mount), AccelerationIntegral(), mount
    )
    places.update(maps, int(t_s[-1] * 1e9), final=True)
    return climb, maps, places


def test_a_straight_climb_has_the_heading_of_the_map_after_it() -> None:
    climb, maps, places = flight()
    found = in_world(places, maps[0])
    assert found is not None
    for pose, true in zip(found, climb, strict=True):
        assert angle_between(pose.rotation, true.rotation) < np.radians(1.0)
        np.testing.assert_allclose(pose.translation, true.translation, atol=0.1)
    georeference = places.of(maps[0])
    assert georeference is not None
    assert np.radians(3.0) < georeference.sigma_yaw_rad < np.radians(8.0)


@pytest.mark.parametrize(
    ("gap", "turn_rad_s", "tilt_rad"),
    [(4, 0.0, 0.0), (2, np.radians(20.0), 0.0), (2, 0.0, np.radians(40.0))],
    ids=["lost for long", "turns where it is found again", "tilted against its path"],
)
def test_a_climb_has_none_where_the_rotation_may_have_changed(
    gap: int, turn_rad_s: float, tilt_rad: float
) -> None:
    _, maps, places = flight(gap, turn_rad_s, tilt_rad)
    assert in_world(places, maps[1]) is not None
    assert in_world(places, maps[0]) is None
