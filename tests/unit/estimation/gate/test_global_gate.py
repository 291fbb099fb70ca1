"""Which positions are given out in latitude and longitude: never the satellites' echo."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from companion.config import MEASUREMENTS, FeedbackConfig
from companion.estimation.gate.global_gate import (
    ECHO,
    IN_USE,
    NOT_PLACED,
    OTHER_SOURCE,
    UNCERTAIN,
    WITHOUT_NS,
    GlobalGate,
    GlobalToSend,
)
from companion.estimation.gate.pose_to_send import PoseToSend
from companion.geometry.geodesy import GeoOrigin, ned_from_geodetic
from companion.geometry.transforms import Pose, Similarity
from companion.messages import Georeference
from companion.telemetry import PositionSample, PositionSource

S = 1_000_000_000
ORIGIN = GeoOrigin(47.4, 8.55, 430.0)
PLACED = Georeference(Similarity.identity(), 0.004, 0.01, "GPS", 40, 0.6)
BLIND = tuple(each for each in MEASUREMENTS if each != "satellites")


class Flown:
    """A pose each 0.2 s, north at 10 m/s, and a position of satellites with each."""

    def __init__(self, use: Any = MEASUREMENTS, **config: Any) -> None:
        given = {"global_position": "sensor", **config}
        self.gate = GlobalGate(FeedbackConfig(**given), use)
        self.gate.take_georeference(PLACED)
        self.t_ns, self.north_m = 10**18, 0.0

    def fly(
        self, seconds: float, source: PositionSource | None = None,
        origin: GeoOrigin | None = ORIGIN,
    ) -> GlobalToSend | None:  # fmt: skip
        found = None
        for _ in range(round(seconds * 5)):
            self.t_ns += S // 5
            self.north_m += 2.0
            place = np.array([self.north_m, 3.0, -20.0])
            if source is not None:
                self.gate.take_position(PositionSample(self.t_ns, source, place))
            pose = PoseToSend(self.t_ns, Pose(np.eye(3), place), np.array([10.0, 0, 0]),
                              0.2, 0.1, 0.01, 0.01, 80, 1)  # fmt: skip
            found = self.gate.take(pose, origin, self.t_ns + S // 20)
        return found


def test_nothing_while_satellites_place_the_map() -> None:
    flown = Flown()
    assert flown.fly(10, PositionSource.GPS) is None
    assert flown.gate.why_not == IN_USE
    assert flown.fly(WITHOUT_NS / S - 1) is None
    assert flown.fly(1.4) is not None
    assert flown.fly(0.2, PositionSource.GPS) is None


def test_it_is_where_the_map_is() -> None:
    flown = Flown()
    flown.fly(2, PositionSource.GPS)
    given = flown.fly(20)
    assert given is not None
    place = ned_from_geodetic(given.latitude_deg, given.longitude_deg, given.altitude_m, ORIGIN)
    assert place == pytest.approx([flown.north_m, 3.0, -20.0], abs=1e-3)


def test_its_error_grows_from_where_satellites_left_it() -> None:
    flown = Flown()
    flown.fly(2, PositionSource.GPS)
    soon, later = flown.fly(6), flown.fly(94)
    assert soon is not None and later is not None
    assert 1.5 < soon.sigma_horizontal_m < 2.0
    # 1 km: heading to 10 mrad, scale to 0.4 %
    assert later.sigma_horizontal_m == pytest.approx(np.hypot(10.0, 4.0), rel=0.1)
    assert flown.fly(500) is None and flown.gate.why_not == UNCERTAIN


def test_satellites_that_are_doubted_do_not_count() -> None:
    """From when they are: those of before placed the map, and are no echo."""
    flown = Flown()
    flown.fly(5, PositionSource.GPS)
    flown.gate.doubted = True
    assert flown.fly(0.2, PositionSource.GPS) is not None
    flown.gate.doubted = False
    assert flown.fly(0.2, PositionSource.GPS) is None


def test_the_autopilots_own_estimate_is_no_satellite() -> None:
    assert Flown().fly(6, PositionSource.GLOBAL) is not None


def test_one_source_at_a_time() -> None:
    flown = Flown(mode="odometry")
    assert flown.fly(10) is None and flown.gate.why_not == OTHER_SOURCE
    assert Flown(mode="velocity").fly(10) is not None  # knows nothing of where the map lies


def test_gps_input_only_where_satellites_place_nothing() -> None:
    """What is sent comes back as the autopilot's GPS."""
    echo = Flown(global_position="gps_input")
    assert echo.fly(10) is None and echo.gate.why_not == ECHO
    assert Flown(BLIND, global_position="gps_input").fly(10, PositionSource.GPS) is not None


def test_a_map_without_a_place_on_earth_gives_none() -> None:
    flown = Flown()
    assert flown.fly(10, origin=None) is None and flown.gate.why_not == NOT_PLACED
    flown.gate.take_georeference(None)
    assert flown.fly(1) is None and flown.gate.why_not == NOT_PLACED
    free = Georeference(Similarity.identity(), 0.004, 0.01, "range", 0, 0.1, has_origin=False)
    flown.gate.take_georeference(free)
    assert flown.fly(1) is None and flown.gate.why_not == NOT_PLACED
