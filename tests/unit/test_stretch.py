"""A map whose scale is adjusted stretches what was measured in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from companion.geometry import Pose
from companion.messages import MapUpdate, PointChunk
from companion.output.flight_result import FlightResult

N = 20


def update(scale: float = 1.0, unit: float = 1.0) -> MapUpdate:
    rng = np.random.default_rng(4)
    places = {k: Pose(np.eye(3), scale * unit * rng.uniform(0, 5, 3)) for k in range(N)}
    units = {} if unit == 1.0 else dict.fromkeys(places, unit)
    return MapUpdate(1, 0, places, np.zeros((0, 3)), None, units)


def test_spans_tell_how_the_map_was_stretched() -> None:
    spans = update().spans_of(8)
    assert set(spans) == {2, 3, 4, 5, 6, 7, 9, 10, 11, 12, 13, 14}
    assert update().stretch_of(8, spans) == 1.0
    assert update(0.98).stretch_of(8, spans) == pytest.approx(0.98)


def test_another_unit_is_no_stretch() -> None:
    assert update(unit=7.0).stretch_of(8, update().spans_of(8)) == pytest.approx(1.0)


def test_keyframes_that_went_elsewhere_do_not_tell() -> None:
    spans = update().spans_of(8)
    now = update(1.02)
    there = {**now.map_from_camera, 6: Pose(np.eye(3), np.full(3, 90.0))}
    del there[10]
    moved = replace(now, map_from_camera=there, unit_of={12: 3.0})
    assert moved.stretch_of(8, spans) == pytest.approx(1.02)


def test_what_nobody_tells_of_is_not_stretched() -> None:
    assert update(2.0).stretch_of(8, {}) == 1.0
    assert update(2.0).stretch_of(N + 50, {3: 1.0}) == 1.0
    assert update(2.0).spans_of(N + 50) == {}


def test_points_of_the_cloud_are_stretched_with_the_map() -> None:
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
