"""The way back of a flight: from when, of which poses, to which home."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import LinkConfig
from companion.daemon.control.way_back import SAME_NS, WayBack
from companion.geometry.geodesy import GeoOrigin, ned_from_geodetic
from companion.geometry.transforms import Array, Pose, Similarity
from companion.messages import Georeference, Georeferenced, Odometry, TrackState
from companion.pilot_messages import PilotText
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.vehicle import vehicle_of
from tests.support.autopilot.ground_station import asked
from tests.support.autopilot.memory_port import MemoryPort

ORIGIN = GeoOrigin(47.3977, 8.5456, 488.0)
MIN_QUALITY = 20
ARDUPILOT, PX4 = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, mavlink.MAV_AUTOPILOT_PX4


class Link(AutopilotLink):
    """A link whose origin a test sets."""

    place: GeoOrigin | None = ORIGIN

    @property
    def origin(self) -> GeoOrigin | None:
        return self.place


class Clock(FlightClock):
    t_ns = 0

    def now_ns(self) -> int:
        self.t_ns += SAME_NS
        return self.t_ns


class Flown:
    """A daemon's way back, and what was told of it."""

    def __init__(self, autopilot: int = PX4) -> None:
        self.armed, self.told = False, list[tuple[PilotText, str, bool]]()
        self.link = Link(LinkConfig(), MemoryPort(), Clock(), lambda _: None, lambda _: None)
        self.link.vehicle = vehicle_of(
            asked(mavlink.MAVLink_heartbeat_message(2, autopilot, 0, 0, 4, 3), 1, 1)
        )
        self.way = WayBack(
            self.link, Clock(), lambda: self.armed, lambda: MIN_QUALITY,
            lambda *told: self.told.append(told),
        )  # fmt: skip
        self.place(True)

    def place(self, has_origin: bool) -> None:
        world = Similarity(1.0, np.eye(3), np.zeros(3))
        found = Georeference(world, 0.0, 0.0, "positions", 50, 0.4, has_origin)
        self.way.take_georeference(Georeferenced(0, found))

    def fly(
        self, path: Array, state: TrackState = TrackState.TRACKING, known: bool = True,
        quality: int = MIN_QUALITY,
    ) -> None:  # fmt: skip
        for n, place in enumerate(path):
            pose = Pose(np.eye(3), place) if known else None
            self.way.take_odometry(Odometry(n, n, state, 0, quality, pose, np.zeros(3), 0.1))

    def waypoints(self) -> Array:
        """In NED at the origin."""
        rows = self.way.waypoints().tolist()
        found = [ned_from_geodetic(lat, lon, high, ORIGIN) for lat, lon, high in rows]
        return np.stack(found).round(6)


def line(a: list[float], b: list[float], n: int = 100) -> Array:
    return np.linspace(a, b, n)


OUT = np.concatenate([line([0, 0, 0], [0, 0, -20]), line([0, 0, -20], [60, 0, -20])])


def test_the_way_back_begins_here_and_ends_where_it_was_armed() -> None:
    flown = Flown()
    flown.fly(OUT + [500.0, 0, 0])  # carried about
    flown.armed = True
    flown.fly(OUT)
    assert flown.waypoints() == pytest.approx(np.array([[60, 0, -20], [0, 0, -20], [0, 0, 0]]))
    (text, detail, good) = flown.told[-1]
    assert (text.text, good) == ("Companion: way back: 3 waypoints", True)
    assert "3 waypoints, 80 m, within 0.5 m of the path, placed within 1.5 m" in detail
    flown.fly(line([60, 0, -20], [60, 40, -20]))
    assert len(flown.waypoints()) == 4
    flown.armed = False
    flown.fly(OUT[::-1] + [0, 9.0, 0])  # carried home
    assert len(flown.waypoints()) == 4
    flown.armed = True
    flown.fly(OUT[:100])
    assert len(flown.waypoints()) == 2


def test_ardupilots_missions_begin_with_home() -> None:
    flown = Flown(ARDUPILOT)
    flown.armed = True
    flown.fly(OUT)
    found = flown.waypoints()
    assert len(found) == 4
    assert found[0] == pytest.approx(np.zeros(3), abs=1e-6) and found[1][0] == pytest.approx(60)


def without_place(flown: Flown) -> None:
    flown.place(False)
    flown.fly(OUT)


def without_map(flown: Flown) -> None:
    flown.way.take_georeference(Georeferenced(0, None))
    flown.fly(OUT)


def without_origin(flown: Flown) -> None:
    flown.link.place = None
    flown.fly(OUT)


def lost(flown: Flown) -> None:
    flown.fly(OUT, TrackState.LOST)


def poor(flown: Flown) -> None:
    flown.fly(OUT, quality=MIN_QUALITY - 1)


def unknown(flown: Flown) -> None:
    flown.fly(OUT, known=False)


@pytest.mark.parametrize("how", [without_place, without_map, without_origin, lost, poor, unknown])
def test_what_has_no_place_is_no_way_back(how: Callable[[Flown], None]) -> None:
    flown = Flown()
    flown.armed = True
    how(flown)
    assert flown.way.waypoints().shape == (0, 3)
    assert flown.told[-1][0].text == "Companion: no way back: no path has a place yet"
    flown.link.place = ORIGIN
    flown.place(True)
    flown.fly(OUT)
    assert len(flown.waypoints()) == 3


def test_another_origin_begins_another_path() -> None:
    flown = Flown()
    flown.armed = True
    flown.fly(OUT)
    flown.link.place = GeoOrigin(47.4, 8.5, 480.0)
    flown.fly(OUT[:100])
    assert flown.way.waypoints()[0] == pytest.approx([47.4, 8.5, 500.0])
    assert len(flown.way.waypoints()) == 2
