"""Gravity factor in bundle adjustment: it straightens what images hardly constrain, no more."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.transforms import Pose, rotation_from_vector
from companion.slam.optimisation.bundle_adjustment import Bundle, adjust
from companion.slam.optimisation.gravity_factor import GravityFactor, gravity_in_map
from tests.support.reference.nadir_cameras import FOCAL, LOOKING_DOWN, random_rotation

DOWN = np.array([0.0, 0.0, 1.0])


def test_gradient_matches_the_cost(rng: np.random.Generator) -> None:
    rotation = np.stack([random_rotation(rng, 1.0) for _ in range(6)])
    down = np.stack([random_rotation(rng, 0.03) @ r @ DOWN for r in rotation])
    down[2] = np.nan
    factor = GravityFactor(down, DOWN, 0.02)
    still = np.zeros((6, 3))
    information, gradient = np.zeros((5, 6, 5, 6)), np.zeros((5, 6))
    factor.add_normal_equations(information, gradient, rotation, still)
    assert not information[2].any()
    assert np.linalg.eigvalsh(information.reshape(30, 30)).min() > -1e-6
    step = 1e-6
    for camera in range(5):
        for axis in range(3):
            moved = rotation.copy()
            moved[camera] = rotation_from_vector(step * np.eye(3)[axis]) @ rotation[camera]
            slope = (factor.cost(moved, still) - factor.cost(rotation, still)) / step
            assert gradient[camera, axis] == pytest.approx(slope, rel=1e-3, abs=1e-2)


def test_gravity_in_map_is_the_consensus(rng: np.random.Generator) -> None:
    level = random_rotation(rng, 0.2)
    rotation = np.stack([random_rotation(rng, 1.0) for _ in range(60)])
    down = np.stack([random_rotation(rng, np.radians(0.6)) @ r @ level @ DOWN for r in rotation])
    down[:6] = -down[:6]
    found = gravity_in_map(rotation, down)
    assert found is not None
    assert np.degrees(np.arccos(found[0] @ level @ DOWN)) < 0.3
    assert np.degrees(found[1]) == pytest.approx(2 * 0.6, rel=0.3)


def test_no_gravity_from_a_gimbal_or_from_few(rng: np.random.Generator) -> None:
    rotation = np.stack([random_rotation(rng, 1.0) for _ in range(60)])
    down = rotation @ DOWN
    assert gravity_in_map(rotation, np.stack([random_rotation(rng, 0.2) @ d for d in down])) is None
    down[4:] = np.nan
    assert gravity_in_map(rotation, down) is None


@pytest.mark.parametrize("wrong", [False, True], ids=["all right", "one is wrong"])
def test_climb_over_a_plane_stays_upright(rng: np.random.Generator, wrong: bool) -> None:
    """Images alone allow a tilt of degrees."""
    ground = np.c_[rng.uniform(-3, 3, (60, 2)), np.zeros(60)]
    truth = [
        Pose(LOOKING_DOWN, -LOOKING_DOWN @ np.array([0.0, 0.0, -4.0 - 0.5 * k])) for k in range(10)
    ]
    seen = []
    for pose in truth:
        p = pose.apply(ground)
        seen.append(p[:, :2] / p[:, 2:] + rng.normal(scale=1.0 / FOCAL, size=(60, 2)))
    leaning = [
        Pose(
            rotation_from_vector(np.radians([0.6, -0.4, 0.0]) * max(k - 1, 0)) @ pose.rotation,
            pose.translation,
        )
        for k, pose in enumerate(truth)
    ]
    down = np.stack([random_rotation(rng, np.radians(0.4)) @ p.rotation @ DOWN for p in truth])
    if wrong:
        down[5] = rotation_from_vector(np.array([0.5, 0.0, 0.0])) @ down[5]
    order = [*range(2, 10), 0, 1]
    camera = np.repeat(np.arange(10), 60)

    def lean_deg(factor: GravityFactor | None) -> float:
        bundle = Bundle(
            [leaning[k] for k in order], 8, ground + rng.normal(scale=0.02, size=ground.shape),
            camera, np.tile(np.arange(60), 10), np.concatenate([seen[k] for k in order]),
            np.broadcast_to(np.eye(2) * FOCAL, (600, 2, 2)),
            () if factor is None else (factor,),
        )  # fmt: skip
        result = adjust(bundle, 15)
        cosine = [
            float((result.poses[i].rotation.T @ truth[k].rotation @ DOWN)[2])
            for i, k in enumerate(order)
        ]
        off = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        return float(np.sqrt((off**2).mean()))

    alone = lean_deg(None)
    upright = lean_deg(GravityFactor(down[order], DOWN, np.radians(0.6)))
    assert upright < 0.5
    assert upright < 0.7 * alone
