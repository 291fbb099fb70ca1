"""Global positions sent to an autopilot on a link without a wire, and what is not sent."""

from __future__ import annotations

import asyncio
import math
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.app.replay.sent_again import SentAgain
from companion.config import MEASUREMENTS, Config, FeedbackConfig
from companion.daemon.pose.global_sender import UNHEARD, GlobalSender
from companion.estimation.gate.gate_journal import GLOBAL
from companion.estimation.gate.global_gate import NOT_PLACED
from companion.flight_notes import GateStep
from companion.geometry.geodesy import GeoOrigin, geodetic_from_ned
from companion.geometry.transforms import Pose, Similarity
from companion.messages import Georeference, Georeferenced, Odometry, TrackState
from companion.telemetry import AttitudeSample, PositionSample, PositionSource, Telemetry
from drivers.recording.decisions import Decisions, payloads_of
from tests.support.autopilot.memory_link import SetClock, listen, memory_link
from tests.support.autopilot.memory_port import MemoryPort
from tests.support.flights.recorded_steps import recorded

MS = 1_000_000
Message = Literal["sensor", "estimate", "gps_input"]
NAMES = {
    "sensor": "GLOBAL_POSITION_SENSOR", "estimate": "COMMAND_INT", "gps_input": "GPS_INPUT",
}  # fmt: skip
ORIGIN = GeoOrigin(47.4, 8.55, 430.0)
LATENCY_NS = 60 * MS
PLACE = np.array([120.0, -40.0, -30.0])
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


class Vehicle:
    """Hovers at a place of which the autopilot has told the origin; frames at 20 Hz."""

    def __init__(self, message: Message) -> None:
        self.clock, self.port, self.message = SetClock(), MemoryPort(), message
        self.link = memory_link(self.port, self.clock, self._deliver)
        use = set(MEASUREMENTS) - ({"satellites"} if message == "gps_input" else set())
        self.steps: list[GateStep] = []
        self.samples: list[Telemetry] = []
        self.odometry: dict[int, Odometry] = {}
        self.use = tuple(use)
        self.sender = GlobalSender(
            FeedbackConfig(global_position=message), self.link, self.clock, use, self.steps.append
        )
        asyncio.run(listen(self.link))
        self._hear()
        self.port.hear(
            mavlink.MAVLink_gps_global_origin_message(
                round(ORIGIN.latitude_deg * 1e7), round(ORIGIN.longitude_deg * 1e7),
                round(ORIGIN.altitude_m * 1e3),
            ),
            self.clock.t_ns,
        )  # fmt: skip
        self.place()
        self.seq = 0

    def _deliver(self, sample: Telemetry) -> None:
        pass

    def _hear(self) -> None:
        self.port.hear(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3), self.clock.t_ns)

    def place(self) -> None:
        placed = Georeference(Similarity.identity(), 0.002, 0.01, "GPS", 40, 0.6)
        self.sender.take_georeference(Georeferenced(self.clock.t_ns, placed))

    def run(self, seconds: float, satellites: bool = False) -> list[Any]:
        n_before = len(self.sent)
        for _ in range(round(seconds * 20)):
            self.clock.t_ns += 50 * MS
            self.seq += 1
            now_ns = self.clock.t_ns
            attitude = AttitudeSample(now_ns, LEVEL, np.zeros(3))
            self.samples.append(attitude)
            self.sender.take_attitude(attitude)
            if satellites:
                position = PositionSample(now_ns, PositionSource.GPS, PLACE)
                self.samples.append(position)
                self.sender.take_position(position)
            self.odometry[self.seq] = Odometry(
                self.seq, now_ns - LATENCY_NS, TrackState.TRACKING, 1, 90,
                Pose(np.eye(3), PLACE), np.zeros(3), 0.1, 0.05, 0.005, 0.01,
            )  # fmt: skip
            self.sender.take(self.odometry[self.seq])
        return self.sent[n_before:]

    @property
    def sent(self) -> list[Any]:
        return self.port.of(NAMES[self.message])

    @property
    def texts(self) -> list[str]:
        return [str(each.text) for each in self.port.of("STATUSTEXT")]


def where() -> Any:
    return geodetic_from_ned(PLACE[None], ORIGIN)[0]


@pytest.mark.parametrize(("message", "rate_hz"), [("sensor", 5), ("estimate", 1), ("gps_input", 5)])
def test_each_message_says_where_it_is(message: Message, rate_hz: int) -> None:
    vehicle = Vehicle(message)
    sent = vehicle.run(11.0)
    assert 9 * rate_hz <= len(sent) <= 10 * rate_hz + 1
    last = sent[-1]
    latitude, longitude = (last.x, last.y) if message == "estimate" else (last.lat, last.lon)
    assert latitude == pytest.approx(where()[0] * 1e7, abs=1)
    assert longitude == pytest.approx(where()[1] * 1e7, abs=1)
    assert vehicle.sender.health().sending
    assert vehicle.sender.health().rate_hz == pytest.approx(rate_hz, abs=0.6)
    assert vehicle.texts == ["Companion: global position by vision: no GPS"]


def test_px4s_has_the_time_of_the_image_and_its_error() -> None:
    last = Vehicle("sensor").run(3.0)[-1]
    assert last.processing_time == LATENCY_NS // 1000
    assert last.source == mavlink.GLOBAL_POSITION_SRC_VISION
    assert last.alt == pytest.approx(where()[2], abs=0.01)
    assert 1.5 < last.eph < 2.0 and last.eph == last.epv and math.isnan(last.alt_ellipsoid)


def test_ardupilots_is_a_command_with_its_delay_and_without_altitude() -> None:
    last = Vehicle("estimate").run(3.0)[-1]
    assert (last.command, last.frame) == (43003, mavlink.MAV_FRAME_GLOBAL)
    assert last.param2 == pytest.approx(1e-9 * LATENCY_NS)
    assert 1.5 < last.param3 < 2.0 and math.isnan(last.z)
    assert 0 <= last.param1 < 36000


def test_gps_input_has_gps_time() -> None:
    """Of 2026-11-18 09:06:40 UTC and somewhat more: week 2445, and 18 leap seconds."""
    vehicle = Vehicle("gps_input")
    last = vehicle.run(3.0)[-1]
    unix_s = (vehicle.clock.t_ns - LATENCY_NS) * 1e-9
    told_s = last.time_week * 604_800 + last.time_week_ms * 1e-3 - 18 + 315_964_800
    assert told_s == pytest.approx(unix_s, abs=0.25)
    assert (last.fix_type, last.vn) == (3, 0.0)


def test_nothing_beside_satellites_or_to_a_silent_autopilot() -> None:
    vehicle = Vehicle("sensor")
    assert vehicle.run(3.0, satellites=True) == []
    assert vehicle.run(8.0) != []
    assert vehicle.run(4.0, satellites=True) == []
    assert vehicle.texts[-1] == "Companion: global position by vision off"
    vehicle.sender.doubt_satellites(True)
    assert vehicle.run(1.0, satellites=True) != []
    vehicle.link.alive = False  # as its watch finds after three seconds
    assert vehicle.run(1.0) == []
    assert vehicle.sender.health().why_not == UNHEARD


def test_another_localisation_begins_without_a_place() -> None:
    """Its vehicle may stand where its own world begins, before any map is placed."""
    vehicle = Vehicle("sensor")
    vehicle.sender.doubt_satellites(True)
    assert vehicle.run(3.0, satellites=True) != []
    vehicle.sender.begin_flight(vehicle.use)
    vehicle.run(0.2)
    assert vehicle.run(3.0, satellites=True) == []
    assert vehicle.run(8.0) == []
    assert vehicle.sender.health().why_not == NOT_PLACED


def test_switched_off_it_is_silent() -> None:
    vehicle = Vehicle("sensor")
    vehicle.run(3.0)
    vehicle.sender.reconfigure(FeedbackConfig())
    assert vehicle.run(2.0) == []


@pytest.mark.parametrize("message", ["sensor", "estimate", "gps_input"])
def test_its_journal_gives_the_messages_again(message: Message) -> None:
    """Of a flight that begins while satellites are there, of which nothing came with it."""
    vehicle = Vehicle(message)
    vehicle.run(3.0, satellites=True)
    vehicle.samples.clear()
    vehicle.steps.clear()
    n_before = len(vehicle.sent)
    vehicle.sender.begin_flight(vehicle.use)
    vehicle.place()
    vehicle.run(7.0)
    vehicle.run(0.5, satellites=True)
    vehicle.sender.doubt_satellites(True)
    vehicle.run(3.0, satellites=True)
    vehicle.sender.reconfigure(FeedbackConfig(global_position=message, min_quality=95))
    vehicle.run(1.0)
    feedback = FeedbackConfig(global_position=message)
    told = Decisions(replace(Config(), feedback=feedback), lossless=True)
    told = replace(
        told, config=replace(told.config, telemetry=replace(told.config.telemetry, use=vehicle.use))
    )
    told.samples.extend(vehicle.samples)
    steps = [recorded(step) for step in vehicle.steps]
    made = SentAgain(told, vehicle.odometry, {}, {}).payloads(steps)
    assert len(vehicle.sent) >= n_before + 4
    assert made == {GLOBAL: payloads_of(vehicle.sent[n_before:])}
