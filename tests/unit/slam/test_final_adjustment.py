"""The adjustment at a flight's end is not bent by matches that are wrong."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Similarity
from companion.slam.map.sparse_map import SlamMap
from companion.slam.mapping.mapper import FINAL_ITERATIONS, Mapper
from companion.slam.mapping.mapping_worker import MapLock
from tests.support.flights.scene import aligned_error
from tests.support.reference.synthetic_map import CAMERA, Ground, flown, mapped

PATH = [flown(np.array([0.8 * k - 16.0, 0.1 * k])) for k in range(40)]
WRONG_SHARE, WRONG_PX = 0.1, 8.0


def with_wrong_matches() -> SlamMap:
    """A map along a line, some of whose matches are off, all to one side."""
    rng = np.random.default_rng(4)
    slam_map = mapped(Ground(rng, half=20.0, n=3000), PATH, Similarity.identity())
    for keyframe in slam_map.keyframes.values():
        wrong = rng.random(len(keyframe.normalised)) < WRONG_SHARE
        keyframe.normalised[wrong, 1] += WRONG_PX / CAMERA.fy
    return slam_map


def error_m(slam_map: SlamMap) -> float:
    centres = np.stack([k.centre for k in slam_map.keyframes.values()])
    return aligned_error(centres, np.stack([p.translation for p in PATH]))[0]


def test_wrong_matches_do_not_bend_the_final_map() -> None:
    once, at_end = with_wrong_matches(), with_wrong_matches()
    Mapper(CAMERA, once, MapLock()).adjust_all(FINAL_ITERATIONS)
    Mapper(CAMERA, at_end, MapLock()).finish()
    assert error_m(at_end) < 0.6 * error_m(once)
