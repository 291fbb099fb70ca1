"""Local scale correction of measurements after adjustment of the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from companion.dense.local_scale import local_scale_of_points
from companion.geometry.transforms import Pose
from companion.messages import MapUpdate, PointChunk
from companion.products.flight_result import FlightResult

N = 20


def update(scale: float = 1.0, unit: float = 1.0) -> MapUpdate:
    rng = np.random.default_rng(4)
    places = {k: Pose(np.eye(3), scale * unit * rng.uniform(0, 5, 3)) for k in range(N)}
    units = {} if unit == 1.0 else dict.fromkeys(places, unit)
    return MapUpdate(1, 0, places, np.zeros((0, 3)), None, units)


def test_spans_give_the_local_scale() -> None:
    spans = update().spans_of(8)
    assert set(spans) == {2, 3, 4, 5, 6, 7, 9, 10, 11, 12, 13, 14}
    assert update().local_scale_of(8, spans) == 1.0
    assert update(0.98).local_scale_of(8, spans) == pytest.approx(0.98)


def test_another_unit_is_no_scale_change() -> None:
    assert update(unit=7.0).local_scale_of(8, update().spans_of(8)) == pytest.approx(1.0)


def test_keyframes_moved_elsewhere_are_outliers() -> None:
    spans = update().spans_of(8)
    now = update(1.02)
    there = {**now.map_from_camera, 6: Pose(np.eye(3), np.full(3, 90.0))}
    del there[10]
    moved = replace(now, map_from_camera=there, scale_of={12: 3.0})
    assert moved.local_scale_of(8, spans) == pytest.approx(1.02)


def test_without_spans_scale_is_one() -> None:
    assert update(2.0).local_scale_of(8, {}) == 1.0
    assert update(2.0).local_scale_of(N + 50, {3: 1.0}) == 1.0
    assert update(2.0).spans_of(N + 50) == {}


def test_cloud_is_rescaled_with_the_map() -> None:
    points = np.random.default_rng(1).uniform(1, 3, (50, 3)).astype(np.float32)
    ones = np.ones(50, np.float32)
    chunk = PointChunk(
        8, 0, points, np.zeros((50, 3), np.uint8), ones, np.zeros((50, 3), np.float32), ones,
        update().spans_of(8),
    )  # fmt: skip
    clouds = []
    for scale in (1.0, 1.05):
        result = FlightResult()
        result.take(chunk)
        result.take(update(scale))
        clouds.append(result.cloud(0.1))
    np.testing.assert_allclose(clouds[1].points, 1.05 * clouds[0].points, rtol=1e-5)
    np.testing.assert_allclose(clouds[1].sigma, 1.05 * clouds[0].sigma, rtol=1e-5)


def wall(n: int, seed: int, z: float = 8.0) -> np.ndarray:
    """Points of a slanted wall in the camera frame."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(-0.5, 0.5, (2, n))
    depth = z / (1.0 + 0.4 * u)
    return np.stack([u * depth, v * depth, depth], 1)


def test_map_points_give_the_local_scale() -> None:
    dense, sparse = wall(40_000, 1), 1.03 * wall(600, 2)
    noise = np.random.default_rng(3).normal(0, 0.01, 600)
    assert local_scale_of_points(dense, sparse * (1 + noise)[:, None]) == pytest.approx(
        1.03, abs=2e-3
    )


def test_occluded_and_occluding_points_are_excluded() -> None:
    hidden, before = wall(400, 4, 9.0), wall(200, 5, 5.0)
    behind_us = -wall(300, 6)
    sparse = np.concatenate([0.98 * wall(500, 2), hidden, before, behind_us])
    assert local_scale_of_points(wall(40_000, 1), sparse) == pytest.approx(0.98, abs=3e-3)


def test_too_few_points_give_none() -> None:
    assert local_scale_of_points(wall(1000, 1), wall(20, 2)) is None
    assert local_scale_of_points(wall(1000, 1), np.zeros((0, 3))) is None
    assert local_scale_of_points(np.zeros((0, 3)), wall(100, 2)) is None
    aside = wall(500, 2) + [50.0, 0.0, 0.0]
    assert local_scale_of_points(wall(1000, 1), aside) is None


def test_map_points_take_precedence_over_spans() -> None:
    dense = wall(20_000, 1).astype(np.float32)
    ones = np.ones(len(dense), np.float32)
    chunk = PointChunk(
        8, 0, dense, np.zeros((len(dense), 3), np.uint8), ones, np.zeros_like(dense), ones,
        update().spans_of(8),
    )  # fmt: skip
    result = FlightResult()
    result.take(chunk)
    now = update(1.05)
    place = now.map_from_camera[8]
    result.take(replace(now, points_map=place.apply(0.97 * wall(500, 2))))
    cloud = result.cloud(0.1).points - place.translation
    assert np.median(cloud[:, 2] * (1 + 0.4 * cloud[:, 0] / cloud[:, 2])) == pytest.approx(
        0.97 * 8.0, rel=2e-3
    )
