"""At a flight's end: passes over the same ground are joined, and wrong matches bend nothing."""

from __future__ import annotations

import numpy as np

from companion.config import FeaturesConfig
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose, Similarity, rotation_from_vector
from companion.slam.features.orb_features import FeatureExtractor
from companion.slam.features.patches import image_levels
from companion.slam.map.local_map import Projector
from companion.slam.map.seen import Seen
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.mapping.mapper import FINAL_ITERATIONS, Mapper
from companion.slam.mapping.mapping_worker import MapLock
from companion.slam.mapping.pass_fusion import fuse_passes
from tests.support.flights.scene import DOWN_LOOKING, PlaneWorld, aligned_error
from tests.support.reference.synthetic_map import CAMERA, Ground, flown, mapped

PATH = [flown(np.array([0.8 * k - 16.0, 0.1 * k])) for k in range(40)]
WRONG_SHARE, WRONG_PX = 0.1, 8.0

SMALL = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
FEATURES = FeaturesConfig(n_features=500)


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


def pass_over(slam_map: SlamMap, world: PlaneWorld, poses: list[Pose]) -> None:
    """Add keyframes at true poses; points are corners of the first, where they truly lie."""
    extractor, projector = FeatureExtractor(FEATURES, SMALL), Projector(SMALL)
    ids = np.zeros(0, np.int64)
    for world_from_camera in poses:
        grey, depth = world.render(SMALL, world_from_camera)
        seen = extractor.extract(grey)
        key, none = len(slam_map.keyframes), np.full(len(seen), -1)
        keyframe = Keyframe(
            key, key, key, world_from_camera.inverse(),
            Seen(seen, seen.normalised.copy(), seen.whitening.copy()), none, none.copy(),
        )  # fmt: skip
        slam_map.keyframes[key] = keyframe
        slam_map.keyframes_moved()
        if len(ids):
            visible = projector.visible(slam_map, keyframe.camera_from_map, ids)
            points, features = projector.search(slam_map, visible, seen, 5.0)
        else:
            column, row = np.rint(seen.pixels).astype(int).T
            rays = np.insert(seen.normalised, 2, 1.0, axis=1) * depth[row, column, None]
            features = np.arange(len(seen))
            points = ids = slam_map.add_points(
                world_from_camera.apply(rays), key, seen, features, image_levels(grey)
            )
        slam_map.add_observations(keyframe, features, points)
        slam_map.update_geometry(ids, [keyframe])


def residuals_px(slam_map: SlamMap, first: range, others: range) -> Array:
    """Errors (M,) of what the `others` see of points that a keyframe of `first` made."""
    out = []
    for key in others:
        keyframe = slam_map.keyframes[key]
        features, ids = slam_map.observations_of(keyframe)
        own = np.isin(slam_map.first_seen[ids], first)
        p = keyframe.camera_from_map.apply(slam_map.positions[ids[own]])
        off = (p[:, :2] / p[:, 2:] - keyframe.normalised[features[own]]) * SMALL.fx
        out.append(np.linalg.norm(off, axis=1))
    return np.concatenate(out)


def test_points_of_two_passes_become_one_where_their_corners_are_the_same() -> None:
    world = PlaneWorld(np.random.default_rng(11))
    slam_map = SlamMap(FEATURES.scale_factor, FEATURES.n_levels, level=True)
    there = [Pose(DOWN_LOOKING, np.array([0.3 * k, 0.0, -12.0])) for k in range(3)]
    turned = DOWN_LOOKING @ rotation_from_vector(np.array([0.02, 0.03, 2.6]))
    back = [Pose(turned, np.array([0.7 - 0.3 * k, 0.4, -12.5])) for k in range(3)]
    pass_over(slam_map, world, there)
    pass_over(slam_map, world, back)
    passes = range(3), range(3, 6)
    assert not len(residuals_px(slam_map, *passes))
    n_points = int(slam_map.alive.sum())
    n_united = fuse_passes(slam_map, Projector(SMALL))
    assert n_united > 20 and slam_map.alive.sum() <= n_points - n_united
    apart_px = np.r_[residuals_px(slam_map, *passes), residuals_px(slam_map, *passes[::-1])]
    assert len(apart_px) > 20
    assert np.median(apart_px) < 0.6  # 1.4 as the corners of each pass are
