"""Which points of a map its updates tell: all of a small one, and at the end."""

from __future__ import annotations

import numpy as np
import pytest

from companion.config import GeoreferenceConfig
from companion.estimation.attitude.camera_attitude import CameraAttitude
from companion.estimation.georeference import segment_georeference
from companion.estimation.georeference.georeferencer import Georeferencer
from companion.estimation.georeference.segment_georeference import SegmentGeoreferences
from companion.estimation.inertial.acceleration_integral import AccelerationIntegral
from companion.geometry.transforms import Pose, Similarity
from tests.support.reference.synthetic_map import Ground, flown, mapped


def test_a_large_map_tells_the_points_about_its_newest_keyframe(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = [flown(p) for p in np.linspace((-25, 0), (25, 0), 20)]
    slam_map = mapped(Ground(np.random.default_rng(4)), path, Similarity.identity(), memory=3)
    mount = Pose.identity()
    places = SegmentGeoreferences(
        Georeferencer(GeoreferenceConfig(), mount), CameraAttitude(mount), AccelerationIntegral(),
        mount,
    )  # fmt: skip
    whole = places.update([slam_map], 0, final=False)
    assert len(whole.points_map) == np.count_nonzero(slam_map.alive)
    monkeypatch.setattr(segment_georeference, "MAX_TOLD_WHOLE", 19)
    monkeypatch.setattr(segment_georeference, "N_TOLD", 4)
    near = places.update([slam_map], 0, final=False)
    wanted = {p for k in range(16, 20) for p in slam_map.observations_of(slam_map.keyframes[k])[1]}
    assert len(near.points_map) == len(wanted) < 0.5 * len(whole.points_map)
    assert len(near.map_from_camera) == 20
    assert near.points_map[:, 0].min() > 5.0
    at_the_end = places.update([slam_map], 0, final=True)
    np.testing.assert_array_equal(at_the_end.points_map, whole.points_map)
