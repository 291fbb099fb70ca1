"""Relative rotation factor in bundle adjustment: it resolves the ambiguity of a plane."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.transforms import Pose, angle_between, rotation_from_vector
from companion.slam.optimisation.bundle_adjustment import Bundle, adjust
from companion.slam.optimisation.rotation_factor import (
    RelativeRotationFactor,
    relative_rotation_factor,
)
from tests.support.reference.nadir_cameras import FOCAL, LOOKING_DOWN, random_rotation


def test_gradient_matches_the_cost(rng: np.random.Generator) -> None:
    ned_from_camera = np.stack([random_rotation(rng, 1.0) for _ in range(6)])
    ned_from_camera[2] = np.nan
    factor = relative_rotation_factor(np.arange(5), np.arange(1, 6), ned_from_camera)
    assert factor is not None and factor.second.tolist() == [1, 4, 5]
    rotation = np.stack([random_rotation(rng, 0.01) @ n.T for n in np.nan_to_num(ned_from_camera)])
    still = np.zeros((6, 3))
    information, gradient = np.zeros((5, 6, 5, 6)), np.zeros((5, 6))
    factor.add_normal_equations(information, gradient, rotation, still)
    flat = information.reshape(30, 30)
    assert flat == pytest.approx(flat.T)
    assert np.linalg.eigvalsh(flat).min() > -1e-6
    assert not gradient[:, 3:].any() and not gradient[2].any()
    step = 1e-6
    for camera in range(5):
        for axis in range(3):
            moved = rotation.copy()
            moved[camera] = rotation_from_vector(step * np.eye(3)[axis]) @ rotation[camera]
            slope = (factor.cost(moved, still) - factor.cost(rotation, still)) / step
            assert gradient[camera, axis] == pytest.approx(slope, rel=2e-2, abs=2e-2)


@pytest.mark.parametrize("wrong_rad", [0.0, 0.3], ids=["right", "quite wrong"])
def test_two_views_of_a_plane_with_short_baseline(
    rng: np.random.Generator, wrong_rad: float
) -> None:
    """Images alone confuse translation and rotation; a grossly wrong measurement does no harm."""
    off: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(20):
        ground = np.c_[rng.uniform(-0.9, 0.9, (80, 2)), 0.05 * rng.normal(size=80)]
        a = Pose(LOOKING_DOWN, -LOOKING_DOWN @ np.array([0.0, 0.0, -4.0]))
        b = Pose(
            random_rotation(rng, 0.02) @ LOOKING_DOWN, -LOOKING_DOWN @ np.array([0.3, 0.1, -4.1])
        )
        seen = []
        for pose in (b, a):
            p = pose.apply(ground)
            seen.append(p[:, :2] / p[:, 2:] + rng.normal(scale=1.0 / FOCAL, size=(80, 2)))
        measured = random_rotation(rng, np.radians(0.3)) @ b.rotation @ a.rotation.T
        measured = rotation_from_vector(np.array([0.0, wrong_rad, 0.0])) @ measured
        factor = RelativeRotationFactor.with_typical_errors(
            np.array([1]), np.array([0]), measured[None]
        )
        for with_turn in (False, True):
            bundle = Bundle(
                [Pose(random_rotation(rng, 0.02) @ b.rotation, b.translation), a], 1, ground.copy(),
                np.repeat([0, 1], 80), np.tile(np.arange(80), 2), np.concatenate(seen),
                np.broadcast_to(np.eye(2) * FOCAL, (160, 2, 2)), (factor,) if with_turn else (),
            )  # fmt: skip
            found = adjust(bundle, 15).poses[0].rotation
            off[with_turn].append(np.degrees(angle_between(found, b.rotation)))
    if wrong_rad:
        assert np.median(off[True]) < np.median(off[False]) + 0.3
    else:
        assert np.median(off[True]) < 0.8
        assert np.median(off[True]) < 0.5 * np.median(off[False])
