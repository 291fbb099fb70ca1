"""Relative pose with approximately known gravity."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from companion.geometry.transforms import (
    Array,
    Pose,
    angle_between,
    quaternion_from_euler,
    rotation_from_quaternion,
    rotation_from_vector,
    yaw_rotation,
)
from companion.slam.optimisation.upright_motion import three_point_motions, upright_motion

BODY_FROM_CAMERA = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
MAX_ERROR = 0.003


class TwoViews(NamedTuple):
    seen_a: Array
    seen_b: Array
    level_from_a: Array
    level_from_b: Array
    b_from_a: Pose


def views(
    seed: int, way: tuple[float, float, float], *, yaw: float = 0.3, pitch: float = -0.5,
    flat: bool = False, noise: float = 0.0, tilt_deg: float = 0.0, wrong: float = 0.0,
) -> TwoViews:  # fmt: skip
    """Points 4 to 30 away, or on ground 10 below; level frames of any heading, with tilt errors."""
    rng = np.random.default_rng(seed)
    a = rotation_from_quaternion(quaternion_from_euler(0.21, pitch, 0.7)) @ BODY_FROM_CAMERA
    b = rotation_from_quaternion(quaternion_from_euler(-0.13, pitch + 0.1, 0.7 + yaw))
    b = b @ BODY_FROM_CAMERA
    seen_a = rng.uniform(-0.6, 0.6, (200, 2))
    rays = np.c_[seen_a, np.ones(200)]
    depth = 10.0 / (rays @ a.T)[:, 2] if flat else rng.uniform(4, 30, 200)
    b_from_a = Pose(b.T @ a, b.T @ -np.array(way))
    points_b = b_from_a.apply(rays * depth[:, None])
    keep = (depth > 0) & (points_b[:, 2] > 0.5)
    seen_a, seen_b = seen_a[keep], points_b[keep, :2] / points_b[keep, 2:]
    seen_a = seen_a + rng.normal(scale=noise, size=seen_a.shape)
    seen_b = seen_b + rng.normal(scale=noise, size=seen_b.shape)
    n_wrong = int(wrong * len(seen_b))
    seen_b[:n_wrong] += rng.uniform(-0.3, 0.3, (n_wrong, 2))
    levels = [
        yaw_rotation(rng.uniform(-3, 3)) @ each
        @ rotation_from_vector(rng.normal(scale=np.radians(tilt_deg), size=3))
        for each in (a, b)
    ]  # fmt: skip
    return TwoViews(seen_a, seen_b, levels[0], levels[1], b_from_a)


def off_deg(found: Pose, truth: Pose) -> tuple[float, float]:
    """Of the rotation, and of the translation's direction."""
    unit = truth.translation / np.linalg.norm(truth.translation)
    way = 2.0 * np.arcsin(min(1.0, 0.5 * float(np.linalg.norm(found.translation - unit))))
    return np.degrees(angle_between(found.rotation, truth.rotation)), np.degrees(way)


def found_in(v: TwoViews, seed: int) -> tuple[Pose, Array]:
    found = upright_motion(*v[:4], MAX_ERROR, seed)
    assert found is not None
    return found[0], np.asarray(found[1], np.float64)


EXACT = {
    "forward": {"way": (1.0, 0.0, 0.0)}, "sideways": {"way": (0.0, 1.0, 0.0)},
    "straight up": {"way": (0.0, 0.0, -1.0)}, "askew": {"way": (0.5, -1.0, 0.3)},
    "over level ground": {"way": (1.0, 0.4, 0.1), "pitch": -1.2, "flat": True},
    "turned right round": {"way": (0.5, 1.0, 0.1), "pitch": -1.5, "yaw": 2.9},
}  # fmt: skip


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", list(EXACT))
def test_the_motion_is_found_exactly(name: str, seed: int) -> None:
    v = views(seed, **EXACT[name])  # type: ignore[arg-type]
    pose, agree = found_in(v, seed)
    turn, way = off_deg(pose, v.b_from_a)
    assert turn < 1e-6 and way < 1e-5
    assert agree.all()


@pytest.mark.parametrize("tilt_deg", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("seed", range(3))
def test_wrong_tilt_does_not_constrain_the_motion(seed: int, tilt_deg: float) -> None:
    v = views(seed, (1.0, 0.3, 0.0), noise=0.0007, tilt_deg=tilt_deg)
    pose, agree = found_in(v, seed)
    turn, way = off_deg(pose, v.b_from_a)
    assert turn < 0.15 and way < 1.5
    assert agree.mean() > 0.95


@pytest.mark.parametrize("seed", range(3))
def test_outliers_are_rejected(seed: int) -> None:
    v = views(seed, (0.3, 1.0, 0.0), noise=0.0007, tilt_deg=0.5, wrong=0.3)
    pose, agree = found_in(v, seed)
    turn, way = off_deg(pose, v.b_from_a)
    assert turn < 0.2 and way < 2.0
    n_wrong = int(0.3 * len(agree))
    assert agree[:n_wrong].mean() < 0.15 and agree[n_wrong:].mean() > 0.95


@pytest.mark.parametrize("noise", [0.0, 0.0007])
def test_pure_rotation_gives_no_translation(noise: float) -> None:
    assert upright_motion(*views(1, (0.0, 0.0, 0.0), noise=noise)[:4], MAX_ERROR, 1) is None


def test_two_matches_are_too_few() -> None:
    v = views(1, (1.0, 0.0, 0.0))
    assert upright_motion(v[0][:2], v[1][:2], v[2], v[3], MAX_ERROR, 1) is None


def test_all_three_point_solutions_are_found() -> None:
    """As many as sign changes of the determinant of the plane normals."""
    several = 0
    for seed in range(30):
        v = views(seed, (0.5, -1.0, 0.3))
        a = np.c_[v.seen_a[:3], np.ones(3)] @ v.level_from_a.T
        b = np.c_[v.seen_b[:3], np.ones(3)] @ v.level_from_b.T
        turns, ways = three_point_motions(a[None], b[None])
        fit = [
            np.abs(np.cross(a @ turn.T, b) @ way).max() < 1e-8  # others are all but real
            for turn, way in zip(turns, ways, strict=True)
        ]
        angles = np.linspace(-np.pi, np.pi, 20_001)
        around = np.stack([yaw_rotation(angle) for angle in angles])
        value = np.linalg.det(np.cross(a @ around.transpose(0, 2, 1), b))
        changes = np.count_nonzero(np.sign(value[1:]) != np.sign(value[:-1]))
        assert sum(fit) == changes
        several += changes == 4
    assert several > 3


def test_the_same_seed_gives_the_same_bytes() -> None:
    v = views(4, (1.0, 0.3, 0.0), noise=0.0007, tilt_deg=1.0, wrong=0.3)
    first, second = found_in(v, 7), found_in(v, 7)
    assert first[0].matrix().tobytes() == second[0].matrix().tobytes()
