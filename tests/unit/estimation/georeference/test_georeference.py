"""Georeference of synthetic paths with known errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from companion.config import GeoreferenceConfig
from companion.estimation.georeference.alignment_sample import AlignmentSample
from companion.estimation.georeference.georeferencer import Georeferencer, place_new_map
from companion.estimation.georeference.trajectory_alignment import Scale
from companion.geometry.transforms import (
    Array,
    Pose,
    Similarity,
    rotation_from_vector,
    yaw_rotation,
)
from companion.telemetry import HeightSample, PositionSample, PositionSource, RangeSample

TRUTH = Similarity(
    3.7, rotation_from_vector(np.array([0.02, -0.01, 0.8])), np.array([12.0, -5.0, -30.0])
)
T0 = 1_700_000_000_000_000_000


def places(
    n: int = 80, attitude_error_rad: float = 0.0
) -> tuple[list[AlignmentSample], np.ndarray]:
    """Keyframes along a lawn-mower path, every half second, and their true positions in NED."""
    k = np.arange(n)
    ned = np.stack([20 * np.sin(k / 9), 0.8 * k, -30 - 2 * np.sin(k / 15)], 1)
    out = []
    for i in range(n):
        rotation = yaw_rotation(0.3 * np.sin(i / 9)) @ rotation_from_vector(
            np.array([0.1, 0.2, 0.0])
        )
        in_map = TRUTH.inverse()
        pose = Pose(TRUTH.rotation.T @ rotation, in_map.apply(ned[i]))
        ned_from_camera = yaw_rotation(attitude_error_rad) @ rotation
        out.append(AlignmentSample(T0 + i * 500_000_000, pose, ned_from_camera, 30.0 / TRUTH.scale))
    return out, ned


def reference(
    ned: np.ndarray, noise: np.ndarray, velocity_noise: np.ndarray | None, mount: Pose | None = None
) -> Georeferencer:
    georeferencer = Georeferencer(GeoreferenceConfig(), mount)
    t = np.arange(0, len(ned) * 0.5, 0.1)
    for i, s in enumerate(t):
        p = np.array(
            [np.interp(s, np.arange(len(ned)) * 0.5, ned[:, a] + noise[:, a]) for a in range(3)]
        )
        v = None
        if velocity_noise is not None:
            v = np.array(
                [
                    np.interp(s, np.arange(len(ned)) * 0.5, np.gradient(ned[:, a], 0.5))
                    for a in range(3)
                ]
            )
            v = v + velocity_noise[i % len(velocity_noise)]
        georeferencer.take(PositionSample(T0 + int(s * 1e9), PositionSource.LOCAL, p, v))
    return georeferencer


def test_exact_positions_give_the_exact_similarity() -> None:
    kept, ned = places()
    found = reference(ned, np.zeros_like(ned), None).solve(kept)
    assert found is not None
    assert found.world_from_map.scale == pytest.approx(TRUTH.scale, rel=1e-3)
    np.testing.assert_allclose(found.world_from_map.rotation, TRUTH.rotation, atol=2e-3)
    np.testing.assert_allclose(
        found.world_from_map.apply(kept[3].map_from_camera.translation), ned[3], atol=0.05
    )


@pytest.mark.parametrize("every", [3, 1], ids=["some", "all"])
def test_the_lever_of_keyframes_without_attitude_is_that_of_the_map(every: int) -> None:
    """A camera two metres ahead of the body on a vehicle that turns; where it is must come out."""
    kept, camera_ned = places()
    mount = Pose(np.eye(3), np.array([2.0, 0.0, 0.0]))
    levers = np.stack([TRUTH.rotation @ k.map_from_camera.rotation @ [2.0, 0, 0] for k in kept])
    without = [replace(k, ned_from_camera=None) for k in kept]
    kept[::every] = without[::every]
    body_ned = camera_ned - levers
    found = reference(body_ned, np.zeros_like(body_ned), None, mount).solve(kept)
    assert found is not None
    away = [found.world_from_map.apply(k.map_from_camera.translation) for k in kept] - camera_ned
    assert np.linalg.norm(away, axis=1).max() < 0.1


@pytest.mark.parametrize("seed", range(4))
def test_slow_drift_of_a_metre_is_within_sigma(seed: int) -> None:
    rng = np.random.default_rng(seed)
    kept, ned = places(attitude_error_rad=0.05)
    drift = np.zeros_like(ned)
    for i in range(1, len(ned)):
        drift[i] = drift[i - 1] * np.exp(-0.5 / 40) + rng.normal(size=3) * np.sqrt(
            1 - np.exp(-1.0 / 40)
        )
    found = reference(ned, drift, rng.normal(scale=0.1, size=(200, 3))).solve(kept)
    assert found is not None
    error = abs(np.log(found.world_from_map.scale / TRUTH.scale))
    assert error < 4 * found.sigma_scale
    assert error < 0.03


def test_position_outliers_for_seconds_are_rejected() -> None:
    kept, ned = places()
    jump = np.zeros_like(ned)
    jump[30:36] = [80.0, -40.0, 10.0]
    found = reference(ned, jump, None).solve(kept)
    assert found is not None
    assert found.world_from_map.scale == pytest.approx(TRUTH.scale, rel=0.02)


def test_keyframes_of_a_merged_map_may_be_unordered() -> None:
    kept, ned = places()
    velocity_noise = np.zeros((1, 3))
    georeferencer = reference(ned, np.zeros_like(ned), velocity_noise)
    in_order = georeferencer.solve(kept)
    joined = georeferencer.solve([*kept[50:], *kept[:50], kept[49]])
    assert in_order is not None and joined is not None
    assert joined.world_from_map.scale == pytest.approx(in_order.world_from_map.scale, rel=1e-3)
    assert np.isfinite(joined.sigma_scale)


def test_hovering_gives_no_scale() -> None:
    kept, ned = places(20)
    still = np.repeat(ned[:1], len(ned), 0)
    assert reference(still, np.zeros_like(still), None).solve(kept) is None


def test_rangefinder_gives_scale_without_position() -> None:
    kept, _ = places()
    georeferencer = Georeferencer(GeoreferenceConfig(), None)
    for i in range(400):
        georeferencer.take(RangeSample(T0 + i * 100_000_000, 30.0))
    found = georeferencer.solve(kept)
    assert found is not None
    assert found.method == "rangefinder"
    assert not found.has_origin
    assert found.world_from_map.scale == pytest.approx(TRUTH.scale, rel=0.01)


def by_barometer(ned: Array) -> Georeferencer:
    """One that has barometric heights of places (N, 3), two a second, and nothing else."""
    georeferencer = Georeferencer(GeoreferenceConfig(), None)
    for i in range(400):
        down = np.interp(i * 0.1, np.arange(len(ned)) * 0.5, ned[:, 2])
        georeferencer.take(HeightSample(T0 + i * 100_000_000, 400.0 - down))
    return georeferencer


def test_barometer_gives_scale_of_a_climb() -> None:
    kept, ned = places()
    georeferencer = by_barometer(ned)
    found = georeferencer.solve(kept)
    assert found is not None
    assert found.method == "barometric height"
    assert found.world_from_map.scale == pytest.approx(TRUTH.scale, rel=0.05)


def test_barometer_and_accelerometers_know_a_scale_better_than_either() -> None:
    kept, ned = places()
    georeferencer = by_barometer(ned)
    alone = georeferencer.solve(kept)
    inertial = Scale(1.1 * TRUTH.scale, 0.06, "accelerometers", 50)
    both = georeferencer.solve(kept, inertial)
    assert alone is not None and both is not None
    assert both.sigma_scale < min(alone.sigma_scale, inertial.sigma)
    assert alone.world_from_map.scale < both.world_from_map.scale < inertial.scale
    assert "accelerometers" in both.method and "barometric height" in both.method


@pytest.mark.parametrize(("scale", "known"), [(1.0, True), (1.4, False)])
def test_rangefinder_contradicted_by_barometer_is_uncertain(scale: float, known: bool) -> None:
    kept, ned = places()
    georeferencer = Georeferencer(GeoreferenceConfig(), None)
    for i in range(400):
        down = np.interp(i * 0.1, np.arange(len(ned)) * 0.5, ned[:, 2])
        georeferencer.take(RangeSample(T0 + i * 100_000_000, 30.0 * scale))
        georeferencer.take(HeightSample(T0 + i * 100_000_000, 400.0 - down))
    assert (georeferencer.solve(kept) is not None) is known


def test_positions_do_not_follow_a_rangefinder_that_they_contradict() -> None:
    """A range may be of other ground than a young map has there, by 15 % all the while."""
    kept, ned = places()
    georeferencer = reference(ned, np.zeros_like(ned), None)
    for i in range(400):
        georeferencer.take(RangeSample(T0 + i * 100_000_000, 1.15 * 30.0))
    found = georeferencer.solve(kept)
    assert found is not None
    assert "rangefinder" in found.method
    off = abs(np.log(found.world_from_map.scale / TRUTH.scale))
    assert off < 0.01
    assert off < 3.0 * found.sigma_scale


def test_no_measurements_give_none() -> None:
    kept, _ = places()
    assert Georeferencer(GeoreferenceConfig(), None).solve(kept) is None


def test_new_map_is_placed_by_velocity() -> None:
    kept, ned = places(4)
    velocity_noise = np.array([[0.1, -0.1, 0.05], [-0.1, 0.1, -0.05]])
    georeferencer = reference(ned, np.zeros_like(ned), velocity_noise)
    travelled = georeferencer.travelled(kept[:3])
    assert travelled is not None
    found = place_new_map(kept[:3], ned[0], *travelled)
    assert found is not None
    np.testing.assert_allclose(found.world_from_map.scale, TRUTH.scale, rtol=0.15)
    np.testing.assert_allclose(
        found.world_from_map.apply(kept[0].map_from_camera.translation), ned[0], atol=1e-6
    )
    off_m = found.world_from_map.apply(kept[2].map_from_camera.translation) - ned[2]
    assert np.linalg.norm(off_m) < 0.15 * np.linalg.norm(ned[2] - ned[0])
    assert found.sigma_scale > 0.02, "two keyframes are no measure"


def test_a_climb_that_no_velocity_tells_does_not_make_a_new_map_small() -> None:
    """Receivers that tell speed and course only say nothing of the vertical: it is not zero."""
    kept, ned = places(4)
    climbed_m = ned[2] - ned[0] - [0.0, 0.0, 5.0]
    up = TRUTH.inverse().apply(ned[2] - [0.0, 0.0, 5.0])
    kept[2] = replace(kept[2], map_from_camera=Pose(kept[2].map_from_camera.rotation, up))
    found = place_new_map(kept[:3], ned[0], np.r_[climbed_m[:2], np.nan], 0.1, "velocity")
    assert found is not None
    np.testing.assert_allclose(found.world_from_map.scale, TRUTH.scale, rtol=0.02)
    level = reference(ned, np.zeros_like(ned), np.tile([0.0, 0.0, np.nan], (2, 1)))
    travelled = level.travelled(kept[:3])
    assert travelled is not None
    assert np.isfinite(travelled[0]).tolist() == [True, True, False]


def test_new_map_is_not_placed_without_velocity() -> None:
    kept, ned = places(4)
    assert reference(ned, np.zeros_like(ned), None).travelled(kept[:3]) is None
