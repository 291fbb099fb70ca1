"""Two-view initialisation with outliers among the matches."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.transforms import Array, Pose, angle_between, rotation_from_vector
from companion.slam.features.orb_features import Features
from companion.slam.initialisation.initializer import TwoViewGeometry, initialise

FOCAL_PX, N = 500.0, 300
TURN = rotation_from_vector(np.radians([2.0, -3.0, 4.0]))
FAR_SHARE = 0.65
FORWARD_FAR_SHARE = 0.3


def features(normalised: Array) -> Features:
    n = len(normalised)
    return Features(
        np.asarray(normalised * FOCAL_PX, np.float32), normalised, np.zeros(n, np.int64),
        np.zeros(n, np.float32), np.zeros((n, 32), np.uint8), np.ones(n),
        np.tile(FOCAL_PX * np.eye(2), (n, 1, 1)),
    )  # fmt: skip


def found_of(
    seen_a: Array, seen_b: Array, measured: Array, rng: np.random.Generator, seed: int
) -> TwoViewGeometry | None:
    """Geometry of normalised coordinates (N, 2), to which half a pixel of noise is added."""
    seen_a, seen_b = (s + rng.normal(scale=0.5 / FOCAL_PX, size=s.shape) for s in (seen_a, seen_b))
    index = np.arange(N)
    return initialise(
        features(seen_a), features(seen_b), index, index, FOCAL_PX, seed, (measured, np.eye(3)),
        np.radians(1.0),
    )  # fmt: skip


def begun(way: float, wrong_share: float, seed: int) -> TwoViewGeometry | None:
    """Sideways motion over distant hills and closer objects: the geometry, if found."""
    rng = np.random.default_rng(seed)
    seen_a = rng.uniform(-0.5, 0.5, (N, 2))
    depth = np.where(rng.random(N) < FAR_SHARE, rng.uniform(150, 400, N), rng.uniform(8, 14, N))
    b_from_a = Pose(TURN, np.array([-way, 0.0, 0.0]))
    points_b = b_from_a.apply(np.c_[seen_a, np.ones(N)] * depth[:, None])
    seen_b = points_b[:, :2] / points_b[:, 2:]
    wrong = rng.permutation(N)[: int(wrong_share * N)]
    seen_b[wrong] = seen_b[np.roll(wrong, 1)]
    return found_of(seen_a, seen_b, TURN, rng, seed)


@pytest.mark.parametrize("wrong_share", [0.0, 0.3])
@pytest.mark.parametrize("seed", range(5))
def test_most_matches_must_show_parallax(seed: int, wrong_share: float) -> None:
    """Wrong matches, which no turn explains, do not count for it."""
    assert begun(0.4, wrong_share, seed) is None


@pytest.mark.parametrize("wrong_share", [0.0, 0.3])
@pytest.mark.parametrize("seed", range(5))
def test_baseline_is_found_among_outliers(seed: int, wrong_share: float) -> None:
    found = begun(6.0, wrong_share, seed)
    assert found is not None
    assert np.degrees(angle_between(found.b_from_a.rotation, TURN)) < 0.3
    assert found.b_from_a.translation[0] < -0.99


def flown_forward(way_m: float, seed: int) -> TwoViewGeometry | None:
    """Forward over the edge of a cliff, most of the picture far away, without attitudes."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(-0.7, 0.7, N), rng.uniform(0.0, 0.4, N)
    far = round(FORWARD_FAR_SHARE * N)
    v[:far] = rng.normal(0.0, 0.03, far)
    depth = np.where(u > 0, 8.0, 30.0) / np.maximum(v, 0.01)  # grass beside the sea below it
    seen_a = np.c_[u, v]
    points_b = np.c_[seen_a, np.ones(N)] * depth[:, None] - [0.0, 0.0, way_m]
    seen_b = points_b[:, :2] / points_b[:, 2:]
    seen_a, seen_b = (s + rng.normal(scale=0.7 / FOCAL_PX, size=s.shape) for s in (seen_a, seen_b))
    index = np.arange(N)
    return initialise(
        features(seen_a), features(seen_b), index, index, FOCAL_PX, seed, None, np.radians(1.0)
    )


@pytest.mark.parametrize("way_m", [0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("seed", range(5))
def test_no_turn_is_seen_in_a_forward_flight(seed: int, way_m: float) -> None:
    """A wrong turn would give what is far a parallax, and win the sooner."""
    found = flown_forward(way_m, seed)
    if found is not None:
        assert np.degrees(angle_between(found.b_from_a.rotation, np.eye(3))) < 1.0
        assert found.b_from_a.translation[2] < -0.99


def test_a_forward_flight_begins() -> None:
    assert all(flown_forward(4.0, seed) is not None for seed in range(5))


def stepped_aside(way_m: float, seed: int) -> TwoViewGeometry | None:
    """A step aside, seen in the middle of the picture, where it looks like a turn."""
    rng = np.random.default_rng(seed)
    n = 120
    seen_a, depth = rng.uniform(-0.15, 0.15, (n, 2)), rng.uniform(8.0, 14.0, n)
    points_b = np.c_[seen_a, np.ones(n)] * depth[:, None] - [way_m, 0.0, 0.0]
    seen_b = points_b[:, :2] / points_b[:, 2:]
    seen_a, seen_b = (s + rng.normal(scale=0.7 / FOCAL_PX, size=s.shape) for s in (seen_a, seen_b))
    index = np.arange(n)
    return initialise(
        features(seen_a), features(seen_b), index, index, FOCAL_PX, seed, None, np.radians(1.0)
    )


def test_direction_must_be_certain_without_attitude() -> None:
    assert all(stepped_aside(0.3, seed) is None for seed in range(6))
    assert any(stepped_aside(1.2, seed) is not None for seed in range(6))


def seen_with(measured: Array, seed: int) -> TwoViewGeometry | None:
    """A step aside by 1.3 to 2.5 degrees of parallax, beside a turn by the autopilot."""
    rng = np.random.default_rng(seed)
    seen_a, depth = rng.uniform(-0.5, 0.5, (N, 2)), rng.uniform(8.0, 15.0, N)
    points_b = np.c_[seen_a, np.ones(N)] * depth[:, None] - [0.35, 0.0, 0.0]
    seen_b = points_b[:, :2] / points_b[:, 2:]
    return found_of(seen_a, seen_b, measured, rng, seed)


@pytest.mark.parametrize("seed", range(5))
def test_a_turn_that_nobody_measured_shows_no_parallax(seed: int) -> None:
    """Wrong matches may agree on one, and then all that is far seems to be near."""
    assert seen_with(np.eye(3), seed) is not None
    assert seen_with(rotation_from_vector(np.radians([0.0, -1.6, 0.0])), seed) is None
