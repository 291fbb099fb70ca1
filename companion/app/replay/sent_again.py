"""Messages to the autopilot, computed again by the journals of the gates."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from companion.errors import FlightError
from companion.estimation.gate.flow_gate import FlowToSend
from companion.estimation.gate.gate_journal import (
    FLOW,
    GLOBAL,
    LANDING,
    POSE,
    SOURCES,
    GateAgain,
    given_again,
)
from companion.estimation.gate.gates_again import (
    DOUBT,
    PLACED,
    FlowGateAgain,
    GlobalGateAgain,
    LandingGateAgain,
    SourceChoiceAgain,
    SourceSet,
)
from companion.estimation.gate.global_gate import GlobalToSend
from companion.estimation.gate.pose_journal import PoseGateAgain
from companion.estimation.gate.pose_to_send import PoseToSend
from companion.estimation.landing.landing_gate import TargetToSend
from companion.flight_notes import GateStep
from companion.messages import LandingTarget, Odometry, OpticalFlow
from drivers.mavlink.commands import source_set_command
from drivers.mavlink.measurements.flow_messages import flow_message
from drivers.mavlink.measurements.global_messages import global_message
from drivers.mavlink.measurements.landing_messages import landing_target_message
from drivers.mavlink.measurements.pose_messages import pose_messages
from drivers.recording.decisions import Decisions, payloads_of

Payloads = dict[str, list[tuple[int, bytes]]]


class SentAgain:
    """Gates of a flight, asked again: of these odometries, targets and flows, by their frames."""

    def __init__(
        self, told: Decisions, odometry: Mapping[int, Odometry],
        targets: Mapping[int, LandingTarget], flows: Mapping[int, OpticalFlow],
    ) -> None:  # fmt: skip
        config, use = told.config, told.config.telemetry.use
        self._told = told
        odometry_of = _found_in(odometry, "odometry")
        self._poses = PoseGateAgain(config.feedback, use, odometry_of)
        self._places = GlobalGateAgain(config.feedback, use, odometry_of)
        self._gates: dict[str, GateAgain] = {
            POSE: self._poses,
            LANDING: LandingGateAgain(use, _found_in(targets, "landing target")),
            GLOBAL: self._places,
            SOURCES: SourceChoiceAgain(config.gps),
            FLOW: FlowGateAgain(config.feedback, _found_in(flows, "optical flow")),
        }

    def payloads(self, steps: Sequence[GateStep]) -> Payloads:
        """Id and payload of each message, by its gate."""
        found: Payloads = defaultdict(list)
        steps = [step for step in steps if step.gate in self._gates]  # without obstacles
        for step, given in given_again(self._gates, steps, self._told.samples):
            if step.sent:
                found[step.gate] += payloads_of(self._messages(step, given))
        return found

    def _messages(self, step: GateStep, given: object) -> tuple[Any, ...]:
        values = step.values
        if isinstance(given, PoseToSend):
            return pose_messages(given, self._poses.config.mode, self._told.firmware)
        if isinstance(given, TargetToSend):
            size_rad = self._told.config.landing.size_m / given.distance_m
            own = values["own_ned_m"]
            own_ned_m = None if own is None else np.array(own, float)
            return (landing_target_message(given, size_rad, own_ned_m),)
        if isinstance(given, FlowToSend):
            return (flow_message(given.flow, given.rates_body_rad_s),)
        if isinstance(given, GlobalToSend):
            kind = self._places.config.global_position
            return (global_message(given, kind, values["system"], step.t_ns),)
        assert isinstance(given, SourceSet)
        return (source_set_command(values["system"], given.number),)


def steps_as_tracked(
    steps: Sequence[GateStep], places: Sequence[Mapping[str, object]], verdicts: Sequence[bool]
) -> Iterator[GateStep]:
    """Steps with the places of the map and the verdicts on satellites of a replay.

    FlightError where the replay has fewer of them than the flight.
    """
    inputs: dict[str, Sequence[Mapping[str, object]]] = {
        PLACED: places, DOUBT: [{"doubted": doubted} for doubted in verdicts]
    }  # fmt: skip
    n_taken: Counter[tuple[str, str]] = Counter()
    for step in steps:
        if step.what in inputs:
            found, n = inputs[step.what], n_taken[step.gate, step.what]
            if n >= len(found):
                raise FlightError(
                    f"the gate `{step.gate}` was told `{step.what}` more often than the replay "
                    f"tells it, {len(found)} times"
                )
            step = replace(step, values=found[n])
            n_taken[step.gate, step.what] += 1
        yield step


def _found_in(messages: Mapping[int, Any], what: str) -> Callable[[int], Any]:
    def of(seq: int) -> Any:
        if seq not in messages:
            raise FlightError(f"frame {seq} went to a gate, and its {what} is not recorded")
        return messages[seq]

    return of
