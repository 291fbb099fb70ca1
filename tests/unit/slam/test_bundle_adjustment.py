"""Bundle adjustment, pose refinement, triangulation and initialisation on exact scenes."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.transforms import Array, Pose, angle_between, rotation_from_vector
from companion.slam.features.orb_features import Features
from companion.slam.features.triangulation import triangulate
from companion.slam.initialisation.initializer import initialise
from companion.slam.optimisation.bundle_adjustment import Bundle, adjust
from companion.slam.optimisation.pose_refinement import refine_pose

FOCAL = 400.0


def cameras(n: int) -> list[Pose]:
    """camera_from_world along x, looking at z = 5..9."""
    out = []
    for k in range(n):
        rotation = rotation_from_vector(np.array([0.02 * k, -0.03 * k, 0.05 * k]))
        out.append(Pose(rotation, -rotation @ np.array([0.4 * k, 0.05 * k, 0.0])))
    return out


def project(pose: Pose, points: Array) -> Array:
    p = pose.apply(points)
    out: Array = p[:, :2] / p[:, 2:]
    return out


def scene(rng: np.random.Generator, n: int = 150) -> Array:
    columns = (rng.uniform(-2, 4, n), rng.uniform(-2, 2, n), rng.uniform(5, 9, n))
    return np.stack(columns, 1)


def disturb(pose: Pose, rng: np.random.Generator) -> Pose:
    turn = rotation_from_vector(rng.normal(scale=0.01, size=3))
    return Pose(turn @ pose.rotation, pose.translation + rng.normal(scale=0.05, size=3))


def whitening(n: int) -> Array:
    out: Array = np.broadcast_to(np.eye(2) * FOCAL, (n, 2, 2))
    return out


def test_adjustment_recovers_perturbed_cameras_and_points(rng: np.random.Generator) -> None:
    points, poses = scene(rng), cameras(5)
    camera = np.repeat(np.arange(5), len(points))
    point = np.tile(np.arange(len(points)), 5)
    seen = np.concatenate([project(p, points) for p in poses])
    order = [2, 3, 4, 0, 1]  # the first three of `order` move
    disturbed = [disturb(poses[i], rng) if k < 3 else poses[i] for k, i in enumerate(order)]
    place = np.argsort(order)
    bundle = Bundle(
        disturbed,
        3,
        points + rng.normal(scale=0.1, size=points.shape),
        place[camera],
        point,
        seen,
        whitening(len(seen)),
    )
    result = adjust(bundle, 30)
    assert result.inlier.all()
    np.testing.assert_allclose(result.points, points, atol=1e-4)
    for k in range(3):
        np.testing.assert_allclose(result.poses[k].matrix(), poses[order[k]].matrix(), atol=1e-4)


def test_adjustment_rejects_outliers(rng: np.random.Generator) -> None:
    points, poses = scene(rng), cameras(4)
    camera = np.repeat(np.arange(4), len(points))
    point = np.tile(np.arange(len(points)), 4)
    seen = np.concatenate([project(p, points) for p in poses])
    wrong = rng.permutation(len(seen))[:30]
    seen[wrong] += rng.uniform(0.05, 0.2, (30, 2))
    moved = [poses[0], poses[1], *poses[2:]]
    result = adjust(
        Bundle(moved[::-1], 2, points.copy(), 3 - camera, point, seen, whitening(len(seen))), 20
    )
    assert not result.inlier[wrong].any()
    assert np.count_nonzero(~result.inlier) <= 45


def test_pose_refinement_tolerates_a_third_of_outliers(rng: np.random.Generator) -> None:
    points, pose = scene(rng), cameras(3)[2]
    seen = project(pose, points) + rng.normal(scale=0.5 / FOCAL, size=(len(points), 2))
    seen[:50] += rng.uniform(-0.3, 0.3, (50, 2))
    start = Pose(
        rotation_from_vector(np.array([0.01, 0.02, -0.01])) @ pose.rotation, pose.translation + 0.1
    )
    refined, inlier, information = refine_pose(start, points, seen, whitening(len(seen)))
    assert angle_between(refined.rotation, pose.rotation) < np.radians(0.1)
    np.testing.assert_allclose(refined.translation, pose.translation, atol=0.02)
    assert inlier[50:].mean() > 0.9
    assert np.linalg.eigvalsh(information).min() > 0


def test_triangulation_is_exact_and_detects_parallel_rays(rng: np.random.Generator) -> None:
    points, (a, b) = scene(rng), cameras(2)
    b_from_a = b @ a.inverse()
    found, cosine = triangulate(project(a, points), project(b, points), b_from_a)
    np.testing.assert_allclose(found, a.apply(points), atol=1e-6)
    assert (cosine < 1).all()
    same = project(a, points)
    found, cosine = triangulate(same, same, Pose.identity())
    assert not np.isfinite(found).all(1).any() or (cosine > 1 - 1e-12).all()


def features(normalised: Array) -> Features:
    n = len(normalised)
    pixels = (normalised * FOCAL + 300).astype(np.float32)
    return Features(
        pixels, normalised, np.zeros(n, np.int64), np.zeros(n, np.float32),
        np.zeros((n, 32), np.uint8), np.ones(n), whitening(n),
    )  # fmt: skip


@pytest.mark.parametrize("flat", [False, True], ids=["scene with depth", "plane"])
@pytest.mark.parametrize("prior", [False, True], ids=["vision alone", "with attitude"])
def test_two_views_initialise_a_map(rng: np.random.Generator, flat: bool, prior: bool) -> None:
    points = scene(rng, 400)
    if flat:
        points[:, 2] = 7.0 + 0.15 * points[:, 0]
    a, b = cameras(3)[0], cameras(3)[2]
    b_from_a = b @ a.inverse()
    xa = project(a, points) + rng.normal(scale=0.3 / FOCAL, size=(400, 2))
    xb = project(b, points) + rng.normal(scale=0.3 / FOCAL, size=(400, 2))
    xb[:60] += rng.uniform(-0.2, 0.2, (60, 2))
    turn = rotation_from_vector(np.radians([1.0, -0.7, 1.0])) @ b_from_a.rotation
    attitudes = (turn, np.eye(3)) if prior else None
    index = np.arange(400)
    result = initialise(
        features(xa), features(xb), index, index, FOCAL, 5, attitudes, np.radians(1.0)
    )
    if flat and not prior:  # a plane allows two motions: none may be taken for certain
        assert result is None or angle_between(
            result.b_from_a.rotation, b_from_a.rotation
        ) < np.radians(1)
        return
    assert result is not None
    assert angle_between(result.b_from_a.rotation, b_from_a.rotation) < np.radians(1.0)
    direction = b_from_a.translation / np.linalg.norm(b_from_a.translation)
    assert float(result.b_from_a.translation @ direction) > 0.99
    assert len(result.points_a) > 250


def test_measured_rotation_resolves_planar_ambiguity_at_low_resolution(
    rng: np.random.Generator,
) -> None:
    points = np.c_[rng.uniform(-0.35, 0.35, (140, 2)), rng.normal(1.0, 0.08, 140)]
    climb = Pose(rotation_from_vector(np.array([0.0, 0.01, 0.0])), np.array([0.0, -0.05, 0.14]))
    xa = project(Pose.identity(), points) + rng.normal(scale=1.0 / FOCAL, size=(140, 2))
    xb = project(climb, points) + rng.normal(scale=1.0 / FOCAL, size=(140, 2))
    found = []
    for off_deg in (-0.5, 0.5):
        attitudes = rotation_from_vector(np.radians([off_deg, 0.0, 0.0])) @ climb.rotation
        index = np.arange(140)
        result = initialise(
            features(xa),
            features(xb),
            index,
            index,
            FOCAL,
            5,
            (attitudes, np.eye(3)),
            np.radians(1.0),
        )
        assert result is not None
        found.append(result.b_from_a.rotation)
    assert 0.1 < np.degrees(angle_between(found[0], found[1])) < 1.0


def test_pure_rotation_and_tiny_parallax_do_not_initialise(rng: np.random.Generator) -> None:
    points = scene(rng, 300)
    a = Pose.identity()
    b = Pose(rotation_from_vector(np.array([0.02, 0.1, 0.03])), np.zeros(3))
    xa = project(a, points) + rng.normal(scale=0.3 / FOCAL, size=(300, 2))
    xb = project(b, points) + rng.normal(scale=0.3 / FOCAL, size=(300, 2))
    index = np.arange(300)
    for prior in (None, (b.rotation, np.eye(3))):
        assert (
            initialise(features(xa), features(xb), index, index, FOCAL, 5, prior, np.radians(1.0))
            is None
        )
