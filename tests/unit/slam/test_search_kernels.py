"""Projection and search kernels against numpy."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import (
    Array,
    Pose,
    Similarity,
    rotation_from_vector,
    yaw_rotation,
)
from companion.slam.compiled.searching import find_both
from companion.slam.features.matching import match_epipolar, mutual_matches
from companion.slam.features.orb_features import Features
from companion.slam.map.local_map import Projector, Visible
from companion.slam.map.patch_refinement import _warps
from companion.slam.map.sparse_map import SlamMap
from tests.support.reference import numpy_kernels
from tests.support.reference.synthetic_map import Ground, flown, mapped

LENSES = [
    Camera(640, 480, 500.0, 480.0, 310.0, 245.0),
    Camera(640, 480, 500.0, 480.0, 310.0, 245.0, Distortion.RADTAN, (-0.3, 0.1, 2e-3, -1e-3, 0.02)),
    Camera(
        640, 480, 300.0, 310.0, 325.0, 235.0, Distortion.EQUIDISTANT, (0.05, -0.02, 0.01, -0.002)
    ),
]
AROUND = Similarity(1.7, yaw_rotation(0.7), np.array([3.0, -2.0, 1.0]))


@pytest.fixture(scope="module")
def slam_map() -> SlamMap:
    ground = Ground(np.random.default_rng(5))
    return mapped(ground, [flown(np.array([x, 0.3 * x])) for x in range(-6, 7, 2)], AROUND)


def places(slam_map: SlamMap) -> list[Pose]:
    """Cameras within the map, next to it, and facing away from it."""
    first = slam_map.keyframes[2].camera_from_map
    turn = yaw_rotation(0.4)
    back = np.diag([-1.0, 1.0, -1.0])
    return [
        first,
        Pose(turn @ first.rotation, turn @ first.translation + [1.0, -0.5, 2.0]),
        Pose(first.rotation, first.translation + [9.0, 0.0, 0.0]),
        Pose(back @ first.rotation, back @ first.translation),
    ]


@pytest.mark.parametrize("camera", LENSES, ids=lambda c: c.distortion.value)
def test_visibility_matches_numpy(slam_map: SlamMap, camera: Camera) -> None:
    ids = np.flatnonzero(slam_map.alive)[::3]
    projector = Projector(camera)
    counts = []
    for pose in places(slam_map):
        seen = projector.visible(slam_map, pose, ids)
        wanted = numpy_kernels.visible(camera, slam_map, pose, ids, projector._max_radius)
        np.testing.assert_array_equal(seen.ids, wanted[0])
        np.testing.assert_allclose(seen.pixels, wanted[1], atol=1e-8)
        np.testing.assert_array_equal(seen.octaves, wanted[2])
        counts.append(len(seen.ids))
    assert counts[0] > 40 and counts[1] > 10 and counts[3] == 0


def test_no_points_none_visible(slam_map: SlamMap) -> None:
    none = np.zeros(0, np.int64)
    seen = Projector(LENSES[0]).visible(slam_map, places(slam_map)[0], none)
    assert len(seen.ids) == len(seen.octaves) == 0
    assert seen.pixels.shape == (0, 2)


def crowded(rng: np.random.Generator, n: int) -> Features:
    """Clustered features of many levels whose descriptors differ by few bits."""
    heaps = rng.uniform([5, 5], [635, 475], (max(n // 8, 1), 2))
    pixels = heaps[rng.integers(len(heaps), size=n)] + rng.normal(scale=4.0, size=(n, 2))
    descriptors = np.packbits(rng.random((n, 256)) < 0.15, axis=1)
    return Features(
        np.clip(pixels, 0, [639, 479]).astype(np.float32), np.zeros((n, 2)),
        rng.integers(0, 8, n), np.zeros(n, np.float32), descriptors, np.ones(n),
        np.repeat(np.eye(2)[None], n, 0),
    )  # fmt: skip


@pytest.mark.parametrize("radius_px", [3.0, 15.0, 60.0])
@pytest.mark.parametrize("n", [2, 13, 900])
def test_projected_matches_match_numpy(radius_px: float, n: int) -> None:
    rng = np.random.default_rng(n)
    features = crowded(rng, n)
    slam_map = SlamMap(1.2, 8)
    which = rng.permutation(np.repeat(np.arange(n), 2))[: 2 * n - 1]  # some are wanted twice
    flips = np.packbits(rng.random((len(which), 256)) < 0.05, axis=1)
    slam_map.descriptors = features.descriptors[which] ^ flips
    ids = rng.permutation(len(which))[: max(len(which) - 5, 2)]
    off = rng.normal(scale=0.4 * radius_px, size=(len(ids), 2))
    projected: Array = features.pixels[which[ids]] + off
    levels = np.clip(features.octaves[which[ids]] + rng.integers(-2, 3, len(ids)), 0, 7)
    points, found = Projector(LENSES[0]).search(
        slam_map, Visible(ids, projected, levels), features, radius_px
    )
    wanted, there = numpy_kernels.match_projected(
        projected, slam_map.descriptors[ids], levels, features, radius_px * 1.2**levels
    )
    np.testing.assert_array_equal(points, ids[wanted])
    np.testing.assert_array_equal(found, there)
    assert n < 900 or len(found) > 80


def test_no_features_no_matches() -> None:
    rng = np.random.default_rng(3)
    slam_map = SlamMap(1.2, 8)
    slam_map.descriptors = rng.integers(0, 256, (9, 32)).astype(np.uint8)
    one = Visible(np.array([4]), np.array([[320.0, 240.0]]), np.array([0]))
    none = Visible(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0, np.int64))
    outside = Visible(np.array([4]), np.array([[-900.0, 9e5]]), np.array([0]))
    projector, features = Projector(LENSES[0]), crowded(rng, 50)
    for seen, among in ((none, features), (one, crowded(rng, 0)), (outside, features)):
        points, found = projector.search(slam_map, seen, among, 20.0)
        assert len(points) == len(found) == 0


def test_warps_match_numpy(slam_map: SlamMap) -> None:
    pose = places(slam_map)[1]
    ids = np.flatnonzero(slam_map.alive)[::7]
    jacobian = np.random.default_rng(6).normal(size=(len(ids), 2, 2)) * 200.0
    found = _warps(slam_map, pose, ids, jacobian)
    for first_id in np.unique(slam_map.first_seen[ids]).tolist():
        here = slam_map.first_seen[ids] == first_id
        first = slam_map.keyframes[first_id].camera_from_map
        wanted = numpy_kernels.warps(slam_map, pose, ids[here], jacobian[here], first)
        np.testing.assert_allclose(found[here], wanted, rtol=1e-9)
    slam_map.first_seen[ids[:2]] = 12345  # a keyframe that nobody knows
    assert np.isnan(_warps(slam_map, pose, ids, jacobian)[:2]).all()
    assert _warps(slam_map, pose, ids[:0], jacobian[:0]).shape == (0, 2, 2)


@pytest.mark.parametrize("n", [2, 40, 600])
def test_epipolar_matches_match_numpy(n: int) -> None:
    rng = np.random.default_rng(n)
    camera = LENSES[0]
    points = rng.uniform([-3, -2, 3], [3, 2, 9], (n, 3))
    b_from_a = Pose(rotation_from_vector(np.array([0.02, -0.1, 0.05])), np.array([0.4, 0.1, -0.2]))
    pixels = [camera.project(p) + rng.normal(size=(n, 2)) for p in (points, b_from_a.apply(points))]
    words = np.packbits(rng.random((n, 256)) < 0.15, axis=1)
    levels = rng.integers(0, 8, n)
    seen = []
    for places in pixels:
        flips = np.packbits(rng.random((n, 256)) < 0.03, axis=1)
        octaves = np.clip(levels + rng.integers(-3, 4, n), 0, 7)
        normalised = camera.normalise(places)
        whitening = camera.pixel_from_normalised_jacobian(normalised)
        one = Features(
            places.astype(np.float32), normalised, octaves, np.zeros(n, np.float32), words ^ flips,
            np.ones(n), whitening / 1.2 ** octaves[:, None, None],
        )  # fmt: skip
        seen.append(one)
    a, b = seen
    index_a, index_b = rng.permutation(n)[: n - n // 9], rng.permutation(n)[: n - n // 7]
    found = match_epipolar(a, b, index_a, index_b, b_from_a)
    wanted = numpy_kernels.match_epipolar(a, b, index_a, index_b, b_from_a)
    np.testing.assert_array_equal(found[0], wanted[0])
    np.testing.assert_array_equal(found[1], wanted[1])
    assert n < 600 or len(found[0]) > 100
    assert len(match_epipolar(a, b, index_a[:1], index_b, b_from_a)[0]) == 0


def test_two_ids_are_found_in_one_pass() -> None:
    ids = np.array([4, -1, 7, 4, 9])
    assert find_both(ids, 4, 9) == (0, 2, True)
    assert find_both(ids, 7, 5) == (2, 1, False)
    assert find_both(ids[:0], 7, 5) == (-1, 0, False)


@pytest.mark.parametrize("n_bytes", [32, 2])
def test_matches_by_descriptor_match_numpy(n_bytes: int) -> None:
    """Few bytes give many ties, of which the first counts."""
    rng = np.random.default_rng(n_bytes)
    a, b = np.zeros((300, 32), np.uint8), np.zeros((200, 32), np.uint8)
    a[:, :n_bytes] = rng.integers(0, 256, (300, n_bytes))
    b[:150] = a[rng.permutation(300)[:150]]
    b[:, 0] ^= rng.integers(0, 8, 200).astype(np.uint8)
    expected = numpy_kernels.mutual_matches(a, b, 50, 0.8)
    assert len(expected[0]) > 5
    for found, due in zip(mutual_matches(a, b, 50, 0.8), expected, strict=True):
        np.testing.assert_array_equal(found, due)


def test_one_descriptor_has_no_second_best_and_no_match() -> None:
    same = np.zeros((1, 32), np.uint8)
    assert len(mutual_matches(same, same, 50, 0.8)[0]) == 0
    assert len(mutual_matches(same, same[:0], 50, 0.8)[0]) == 0
