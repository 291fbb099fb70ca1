"""Gates beside that of poses, asked again by their journals."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

from companion.config import FeedbackConfig, GpsConfig, Measurement
from companion.estimation.gate.flow_gate import FlowGate, FlowToSend
from companion.estimation.gate.gate_journal import BEGIN, Takes
from companion.estimation.gate.global_gate import GlobalGate, GlobalToSend
from companion.estimation.gate.pose_gate import PoseGate
from companion.estimation.landing.landing_gate import LandingGate, TargetToSend
from companion.estimation.satellites.source_choice import SourceChoice
from companion.flight_notes import GateStep
from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Similarity
from companion.messages import Georeference, LandingTarget, Odometry, OpticalFlow
from companion.telemetry import AttitudeSample, PositionSample

FRAME, LIMITS = "frame", "limits"
PLACED, DOUBT = "placed", "doubt"
"""The map's place has changed, satellites are doubted or are not any more."""
ASKED, ANSWERED, BOOTED = "asked", "answered", "booted"


class LandingGateAgain:
    """The gate of landing targets; `target_of` gives that of a frame, and raises without one."""

    def __init__(
        self, use: Collection[Measurement], target_of: Callable[[int], LandingTarget]
    ) -> None:
        self._gate, self._target_of = LandingGate(use), target_of
        self.takes: Takes = {AttitudeSample: self._gate.take_attitude}

    def ask(self, step: GateStep) -> TargetToSend | None:
        """Repeat a call; the target that it gives, if any."""
        if step.what != FRAME:
            return None
        return self._gate.take(self._target_of(step.values["seq"]), step.t_ns)


class FlowGateAgain:
    """The gate of optical flow; `flow_of` gives that of a frame, and raises without one."""

    def __init__(self, config: FeedbackConfig, flow_of: Callable[[int], OpticalFlow]) -> None:
        self._gate, self._flow_of = FlowGate(config), flow_of
        self.takes: Takes = {AttitudeSample: self._gate.take_attitude}

    def ask(self, step: GateStep) -> FlowToSend | None:
        """Repeat a call; the flow that it gives, if any."""
        if step.what == LIMITS:
            self._gate.reconfigure(FeedbackConfig(**step.values["limits"]))
        if step.what != FRAME:
            return None
        given = self._gate.take(self._flow_of(step.values["seq"]), step.t_ns)
        if step.sent:
            self._gate.sent(step.t_ns)
        return given


class GlobalGateAgain:
    """The gates of global positions; `odometry_of` as for `PoseGateAgain`."""

    def __init__(
        self, config: FeedbackConfig, use: Collection[Measurement],
        odometry_of: Callable[[int], Odometry],
    ) -> None:  # fmt: skip
        self.config = config
        self._odometry_of = odometry_of
        self._poses, self._gate = PoseGate(config, use=use), GlobalGate(config, use)
        self.takes: Takes = {
            AttitudeSample: self._poses.take_attitude, PositionSample: self._gate.take_position,
        }  # fmt: skip

    def ask(self, step: GateStep) -> GlobalToSend | None:
        """Repeat a call; the position that it gives, if any."""
        values = step.values
        if step.what == BEGIN:
            self._gate.satellites_ns = values["satellites_ns"]
        elif step.what == PLACED:
            self._gate.take_georeference(placed_by(values))
        elif step.what == DOUBT:
            self._gate.doubted = values["doubted"]
        elif step.what == LIMITS:
            self.config = FeedbackConfig(**values["limits"])
            self._poses.reconfigure(self.config)
            self._gate.reconfigure(self.config)
        elif step.what == FRAME:
            pose = self._poses.take(self._odometry_of(values["seq"]), step.t_ns)
            origin = values.get("origin")
            if pose is not None:
                known = None if origin is None else GeoOrigin(*origin)
                return self._gate.take(pose, known, step.t_ns)
        return None


@dataclass(frozen=True, slots=True)
class SourceSet:
    """A source set of the EKF to ask for."""

    number: int


class SourceChoiceAgain:
    """The choice of the EKF's source set."""

    def __init__(self, config: GpsConfig) -> None:
        self._choice = SourceChoice(config)
        self.takes: Takes = {}

    def ask(self, step: GateStep) -> SourceSet | None:
        """Repeat a call; the set that it asks for, if any."""
        choice, values = self._choice, step.values
        if step.what == BEGIN:
            choice.doubted, choice.on_vision = values["doubted"], values["on_vision"]
            choice.not_before_ns = values["not_before_ns"]
        elif step.what == DOUBT:
            choice.doubt_satellites(values["doubted"])
        elif step.what == ASKED:
            number = choice.due(step.t_ns, values["armed"], values["sends_poses"])
            return None if number is None else SourceSet(number)
        elif step.what == BOOTED:
            choice.autopilot_booted()
        elif step.what == ANSWERED:
            choice.answered(values["to_vision"], values["accepted"], step.t_ns)
        return None


def placed_values(found: Georeference | None) -> dict[str, object]:
    """Values of a map's place that the gate of global positions takes; empty without one."""
    if found is None:
        return {}
    return {
        "sigma_scale": float(found.sigma_scale), "sigma_yaw_rad": float(found.sigma_yaw_rad),
        "residual_m": float(found.residual_m), "has_origin": bool(found.has_origin),
    }  # fmt: skip


def placed_by(values: Mapping[str, Any]) -> Georeference | None:
    """The inverse; the place itself, which does not count, is the identity."""
    if not values:
        return None
    scale, yaw_rad, residual_m = (
        math.inf if values[name] is None else values[name]  # as a recording has what is no number
        for name in ("sigma_scale", "sigma_yaw_rad", "residual_m")
    )
    return Georeference(
        Similarity.identity(), scale, yaw_rad, "", 0, residual_m, has_origin=values["has_origin"]
    )
