"""Stored georeference of a resumed map against rangefinder measurements since."""

from __future__ import annotations

import numpy as np
import pytest

from companion.config import GeoreferenceConfig
from companion.estimation.attitude.camera_attitude import CameraAttitude
from companion.estimation.georeference.georeferencer import Georeferencer
from companion.estimation.georeference.segment_georeference import SegmentGeoreferences
from companion.estimation.inertial.acceleration_integral import AccelerationIntegral
from companion.geometry.transforms import Array, Pose, Similarity, quaternion_from_rotation
from companion.messages import Georeference
from companion.slam.map.sparse_map import SlamMap
from companion.telemetry import AttitudeSample, RangeSample
from tests.support.reference.synthetic_map import HEIGHT, Ground, flown, mapped

MOUNT = Pose(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.zeros(3))
METRES_PER_UNIT = 2.0
N = 12


@pytest.fixture(scope="module")
def slam_map() -> SlamMap:
    """Half the size of the world in which its rangefinder measures; its ground is 0 to 2 m high."""
    path = [flown(p) for p in np.linspace((-4, 0), (4, 0), N)]
    to_map = Similarity(1.0 / METRES_PER_UNIT, np.eye(3), np.zeros(3))
    return mapped(Ground(np.random.default_rng(4)), path, to_map)


def known(scale: float, sigma: float, n: int, has_origin: bool) -> Georeference:
    to_world = Similarity(scale, np.eye(3), np.array([100.0, 50.0, 0.0]))
    return Georeference(to_world, sigma, 0.05, "gps", n, 0.0, has_origin)


def placed(slam_map: SlamMap, kept: Georeference | None, measured: Array) -> Georeference:
    """Georeference of the map given these ranges."""
    georeferencer, attitude = Georeferencer(GeoreferenceConfig(), MOUNT), CameraAttitude(MOUNT)
    places = SegmentGeoreferences(georeferencer, attitude, AccelerationIntegral(), MOUNT)
    if kept is not None:
        places.resume(slam_map, kept)
    end_ns = max(k.t_ns for k in slam_map.keyframes.values())
    ned_from_body = flown(np.zeros(2)).rotation @ MOUNT.rotation.T
    for t_ns in range(0, end_ns + 100_000_000, 50_000_000):
        attitude.add(AttitudeSample(t_ns, quaternion_from_rotation(ned_from_body)))
        distance_m = float(np.interp(t_ns, np.linspace(0, end_ns, len(measured)), measured))
        georeferencer.take(RangeSample(t_ns, distance_m))
    places.update([slam_map], end_ns, final=False)
    found = places.of(slam_map)
    assert found is not None
    return found


TRUE = np.full(N, HEIGHT - 1.0)


def test_rangefinder_alone_gives_the_scale(slam_map: SlamMap) -> None:
    found = placed(slam_map, None, TRUE)
    assert found.world_from_map.scale == pytest.approx(METRES_PER_UNIT, rel=0.05)
    assert not found.has_origin


def test_world_position_is_kept(slam_map: SlamMap) -> None:
    """Else the pose of the vehicle would be led to the origin, though nothing has moved."""
    kept = known(METRES_PER_UNIT, 0.08, 3, has_origin=True)
    assert placed(slam_map, kept, TRUE) is kept
    wrong = placed(slam_map, known(1.4 * METRES_PER_UNIT, 0.02, 3, has_origin=True), TRUE)
    assert wrong.has_origin
    assert wrong.sigma_scale == pytest.approx(np.log(1.4), abs=0.05)


@pytest.mark.parametrize(
    ("kept", "stays"),
    [
        (known(1.01 * METRES_PER_UNIT, 0.001, 500, has_origin=False), True),
        (known(METRES_PER_UNIT, 0.001, 3, has_origin=False), False),
        (known(METRES_PER_UNIT, 0.09, 500, has_origin=False), False),
        (known(1.4 * METRES_PER_UNIT, 0.001, 500, has_origin=False), False),
    ],
    ids=["surer", "of fewer", "less sure", "contradicted"],
)
def test_more_certain_scale_is_used(slam_map: SlamMap, kept: Georeference, stays: bool) -> None:
    found = placed(slam_map, kept, TRUE)
    assert (found is kept) == stays
    assert stays or found.method == "rangefinder"
