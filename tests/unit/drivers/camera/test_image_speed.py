"""Speed of the image by telemetry."""

from __future__ import annotations

import numpy as np
import pytest

from companion.telemetry import (
    AttitudeSample,
    ImuSample,
    PositionSample,
    PositionSource,
    RangeSample,
)
from drivers.camera.live_exposure import LEAST_HEIGHT_M, OLD_NS, UNKNOWN_RAD_S, ImageSpeed

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def at_height(t_ns: int, height_m: float, speed_m_s: float) -> PositionSample:
    place, velocity = np.array([3.0, 4.0, -height_m]), np.array([0.0, speed_m_s, 0.0])
    return PositionSample(t_ns, PositionSource.LOCAL, place, velocity)


def test_turn_and_way_add_up() -> None:
    speed = ImageSpeed()
    speed.take(at_height(0, -7.0, 0.0))
    speed.take(at_height(10, 13.0, 5.0))
    speed.take(AttitudeSample(10, LEVEL, np.array([0.3, 0.0, -0.4])))
    assert speed.at(20) == pytest.approx(0.5 + 5.0 / 20.0)
    speed.take(RangeSample(15, 10.0))
    speed.take(ImuSample(15, np.array([0.0, 0.2, 0.0]), np.zeros(3)))
    assert speed.at(20) == pytest.approx(0.2 + 5.0 / 10.0)


def test_what_is_unknown_old_or_no_number_is_not_believed() -> None:
    speed = ImageSpeed()
    assert speed.at(0) == UNKNOWN_RAD_S
    speed.take(AttitudeSample(0, LEVEL, np.array([0.1, 0.0, 0.0])))
    speed.take(at_height(0, 0.0, 1.0))
    assert speed.at(10) == pytest.approx(0.1 + 1.0 / LEAST_HEIGHT_M)
    assert speed.at(OLD_NS + 1) == UNKNOWN_RAD_S
    speed.take(AttitudeSample(20, LEVEL, np.array([np.nan, 0.0, 0.0])))
    assert speed.at(30) == pytest.approx(UNKNOWN_RAD_S + 1.0 / LEAST_HEIGHT_M)
