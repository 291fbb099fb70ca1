from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.transforms import (
    Pose,
    Similarity,
    angle_between,
    interpolate_rotation,
    nearest_rotation,
    quaternion_from_euler,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    skew,
    vector_from_rotation,
    yaw_rotation,
)

ROLL, PITCH, YAW = 0.1, -0.4, 2.0


def test_quaternion_of_an_asymmetric_attitude() -> None:
    """Against the matrix Rz(yaw) Ry(pitch) Rx(roll), written out."""
    rx = np.array([[1, 0, 0], [0, np.cos(ROLL), -np.sin(ROLL)], [0, np.sin(ROLL), np.cos(ROLL)]])
    ry = np.array(
        [[np.cos(PITCH), 0, np.sin(PITCH)], [0, 1, 0], [-np.sin(PITCH), 0, np.cos(PITCH)]]
    )
    q = quaternion_from_euler(ROLL, PITCH, YAW)
    np.testing.assert_allclose(rotation_from_quaternion(q), yaw_rotation(YAW) @ ry @ rx, atol=1e-12)
    assert q[0] > 0


def test_body_axes_in_ned() -> None:
    """Nose up is a forward axis that points up (down is positive); yaw of 90 degrees is east."""
    up = rotation_from_quaternion(quaternion_from_euler(0, np.radians(30), 0))
    assert (up @ [1, 0, 0])[2] == pytest.approx(-0.5)
    east = rotation_from_quaternion(quaternion_from_euler(0, 0, np.pi / 2))
    np.testing.assert_allclose(east @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    right_down = rotation_from_quaternion(quaternion_from_euler(np.radians(30), 0, 0))
    assert (right_down @ [0, 1, 0])[2] == pytest.approx(0.5)


def test_quaternion_round_trip(rng: np.random.Generator) -> None:
    for q in rng.normal(size=(50, 4)):
        unit = q / np.linalg.norm(q)
        unit = unit if unit[0] >= 0 else -unit
        np.testing.assert_allclose(
            quaternion_from_rotation(rotation_from_quaternion(q)), unit, atol=1e-12
        )


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1]])
def test_half_turns(axis: list[float]) -> None:
    """Where the trace is smallest, quaternion extraction is most delicate."""
    r = rotation_from_vector(np.pi * np.array(axis, float))
    np.testing.assert_allclose(rotation_from_quaternion(quaternion_from_rotation(r)), r, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-10, 1e-4, 1.0, 3.1])
def test_rotation_vector_round_trip(angle: float) -> None:
    v = angle * np.array([0.6, -0.48, 0.64])
    np.testing.assert_allclose(vector_from_rotation(rotation_from_vector(v)), v, atol=1e-9)


def test_skew_is_the_cross_product(rng: np.random.Generator) -> None:
    a, b = rng.normal(size=(2, 7, 3))
    np.testing.assert_allclose((skew(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-12)


def test_pose_composition_matches_matrices(rng: np.random.Generator) -> None:
    a_from_b = Pose(rotation_from_vector(rng.normal(size=3)), rng.normal(size=3))
    b_from_c = Pose(rotation_from_vector(rng.normal(size=3)), rng.normal(size=3))
    points_c = rng.normal(size=(4, 3))
    np.testing.assert_allclose(
        (a_from_b @ b_from_c).matrix(), a_from_b.matrix() @ b_from_c.matrix(), atol=1e-12
    )
    np.testing.assert_allclose(
        (a_from_b @ b_from_c).apply(points_c), a_from_b.apply(b_from_c.apply(points_c)), atol=1e-12
    )
    np.testing.assert_allclose((a_from_b @ a_from_b.inverse()).matrix(), np.eye(4), atol=1e-12)


def test_similarity_composition_and_inverse(rng: np.random.Generator) -> None:
    a_from_b = Similarity(2.5, rotation_from_vector(rng.normal(size=3)), rng.normal(size=3))
    b_from_c = Similarity(0.3, rotation_from_vector(rng.normal(size=3)), rng.normal(size=3))
    points = rng.normal(size=(4, 3))
    np.testing.assert_allclose(
        (a_from_b @ b_from_c).apply(points), a_from_b.apply(b_from_c.apply(points)), atol=1e-12
    )
    np.testing.assert_allclose(a_from_b.inverse().apply(a_from_b.apply(points)), points, atol=1e-12)


def test_interpolation_is_uniform() -> None:
    a = rotation_from_vector(np.array([0.3, 0.1, -0.2]))
    b = rotation_from_vector(np.array([-0.5, 0.9, 0.4]))
    whole = angle_between(a, b)
    for fraction in (0.0, 0.25, 1.0, 1.5):
        turned = interpolate_rotation(a, b, fraction)
        assert angle_between(a, turned) == pytest.approx(fraction * whole, abs=1e-9)


def test_rounding_errors_do_not_accumulate() -> None:
    turn = rotation_from_vector(np.array([0.3, -0.2, 0.5]))
    spoilt = turn @ (np.eye(3) + 1e-3 * np.array([[1.0, 2, 0], [0, -1, 1], [1, 0, 2]]))
    mended = nearest_rotation(spoilt)
    np.testing.assert_allclose(mended @ mended.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(mended) == pytest.approx(1.0)
    assert angle_between(mended, turn) < 2e-3
