"""A map initialised with a tilt, or off the autopilot's vertical, is level again in seconds."""

from __future__ import annotations

import time
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from companion.config import Config
from companion.estimation.attitude.attitude_history import AttitudeHistory
from companion.estimation.attitude.attitude_verdict import REINITIALISED
from companion.estimation.localisation import LocalisationStage
from companion.geometry.transforms import (
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
)
from companion.messages import Frame, Message, Odometry, Warned
from companion.runtime.in_order import in_order_of_time
from companion.runtime.stage_protocol import Finish, Setup
from companion.runtime.stage_work import Work
from companion.stages.localisation_work import work
from companion.telemetry import AttitudeSample, Telemetry
from drivers.flight import Flight
from drivers.open_flight import open_flight
from tests.support.flights.tilted_start import KINDS, tilted_starts

SAMPLE = Path(__file__).parents[2] / "sample" / "survey"
SECONDS, SECONDS_LIVE = 6.0, 9.0
"""Live a map that begins with a wrong turn of 40 degrees is georeferenced, or begun anew, later."""
LEVEL_AFTER_S = 3.6
"""The scale, without which there is no pose, is known after 1.6 s; and 2 s."""
MAX_TILT_DEG = 8.0
"""What feedback believes."""


@dataclass
class Flown:
    """Tilts of poses against the autopilot's attitude, by seconds of flight, and what was told."""

    tilts_deg: dict[float, float] = field(default_factory=dict)
    warned: dict[float, str] = field(default_factory=dict)

    def worst_deg(self, after_s: float) -> float:
        late = [tilt for t_s, tilt in self.tilts_deg.items() if t_s > after_s]
        assert len(late) > 5, "hardly any poses"
        return max(late)


@pytest.fixture(scope="module")
def sample() -> tuple[Flight, list[Frame], list[Telemetry]]:
    config = Config()
    flight = open_flight(SAMPLE, config.camera, config.telemetry)
    stop_ns = flight.start_ns + int(SECONDS_LIVE * 1e9)
    frames = []
    for frame in flight.frames():
        if not isinstance(frame, Frame) or frame.t_ns > stop_ns:
            break
        frames.append(frame)
    return flight, frames, [s for s in flight.telemetry().samples if s.t_ns < stop_ns]


def fly(flight: Flight, frames: list[Frame], samples: list[Telemetry], live: bool = False) -> Flown:
    """In lockstep; live: in the daemon's stage, mapping beside it, at the pace of flight."""
    stage: LocalisationStage | Work
    if live:
        stage = work(Setup(Config(), flight.camera))
    else:
        stage = LocalisationStage(Config(), flight.camera, lambda _: nullcontext())
    history, flown = AttitudeHistory(), Flown()
    stop_ns = flight.start_ns + int((SECONDS_LIVE if live else SECONDS) * 1e9)
    frames = [frame for frame in frames if frame.t_ns < stop_ns]
    samples = [sample for sample in samples if sample.t_ns < stop_ns]
    messages: list[Message] = list(in_order_of_time(samples, iter(frames)))
    begun_ns = time.monotonic_ns()
    for message in messages:
        if isinstance(message, AttitudeSample):
            history.add(message)
        elif live and isinstance(message, Frame):
            due_ns = begun_ns + message.t_ns - flight.start_ns
            time.sleep(max(0, due_ns - time.monotonic_ns()) * 1e-9)
        for out in stage.step(message):
            t_s = (getattr(out, "t_ns", flight.start_ns) - flight.start_ns) * 1e-9
            if isinstance(out, Warned):
                flown.warned[t_s] = out.what
            elif isinstance(out, Odometry) and out.world_from_body is not None:
                attitude = history.at(out.t_ns)
                assert attitude is not None
                cosine = attitude[2] @ out.world_from_body.rotation[2]
                flown.tilts_deg[t_s] = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    if isinstance(stage, Work):
        list(stage.finish(Finish(hurry=True)))
    else:
        stage.finish(adjust=False)
    return flown


@pytest.mark.parametrize("tilt_deg", [10.0, 20.0, 40.0])
@pytest.mark.parametrize("kind", KINDS)
def test_poses_are_level_two_seconds_after_a_tilted_start(
    sample: tuple[Flight, list[Frame], list[Telemetry]], kind: str, tilt_deg: float
) -> None:
    with tilted_starts(kind, tilt_deg) as begun:
        flown = fly(*sample)
    assert begun
    late_s = (sample[1][begun[0]].t_ns - sample[1][0].t_ns) * 1e-9
    assert flown.worst_deg(max(LEVEL_AFTER_S, late_s + 2.0)) < MAX_TILT_DEG


@pytest.mark.parametrize(("kind", "tilt_deg"), [("axes", 10.0), ("turn", 20.0), ("depth", 40.0)])
@pytest.mark.real_time
def test_poses_of_the_live_stage_are_level_two_seconds_after_a_tilted_start(
    sample: tuple[Flight, list[Frame], list[Telemetry]], kind: str, tilt_deg: float
) -> None:
    """At the pace of flight; each kind and each tilt once, all of them above."""
    with tilted_starts(kind, tilt_deg) as begun:
        flown = fly(*sample, live=True)
    assert begun
    late_s = (sample[1][begun[0]].t_ns - sample[1][0].t_ns) * 1e-9
    assert flown.worst_deg(max(LEVEL_AFTER_S, late_s + 2.0)) < MAX_TILT_DEG


@pytest.mark.parametrize("tilt_deg", [20.0, 40.0])
def test_a_map_that_the_vertical_leaves_begins_anew(
    sample: tuple[Flight, list[Frame], list[Telemetry]], tilt_deg: float
) -> None:
    """From 1 s to 2 s on the autopilot finds itself tilted, which the map does not."""
    flight, frames, samples = sample

    def tilted(message: Telemetry) -> Telemetry:
        if not isinstance(message, AttitudeSample):
            return message
        since_s = (message.t_ns - flight.start_ns) * 1e-9 - 1.0
        turn = rotation_from_vector(np.radians([tilt_deg * np.clip(since_s, 0.0, 1.0), 0.0, 0.0]))
        attitude = turn @ rotation_from_quaternion(message.ned_from_body)
        return replace(message, ned_from_body=quaternion_from_rotation(attitude))

    flown = fly(flight, frames, [tilted(s) for s in samples])
    anew_s = [t_s for t_s, what in flown.warned.items() if what == REINITIALISED]
    assert anew_s
    assert anew_s[0] < 4.0
    assert flown.worst_deg(SECONDS - 1.0) < MAX_TILT_DEG


def test_nothing_begins_anew_in_a_flight_without_fault(
    sample: tuple[Flight, list[Frame], list[Telemetry]],
) -> None:
    assert not fly(*sample).warned
