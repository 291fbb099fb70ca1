"""Notes of a flight beside its measurements: of the link, the gates, obstacles, and health.

They go to the recording, for a replay as flown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from companion.messages import Floats


@dataclass(frozen=True, slots=True)
class LinkBytes:
    """Bytes of the autopilot's wire; `outgoing` are those sent, ours or clients'."""

    t_ns: int
    monotonic_ns: int
    outgoing: bool
    data: bytes


@dataclass(frozen=True, slots=True)
class LinkReads:
    """Bytes of the link in a row, in one message; `t_ns` is the time of the first."""

    t_ns: int
    parts: tuple[LinkBytes, ...]


@dataclass(frozen=True, slots=True)
class GateStep:
    """One call of a gate of what the autopilot is sent; see `estimation.gate.gate_journal`.

    `t_ns` is the time of the call, `n_samples` the number of samples that the gate took since the
    begin of the flight. `sent` is True if what this call gave went out; `values` are its inputs
    that nothing else in the recording tells.
    """

    t_ns: int
    gate: str
    what: str
    n_samples: int
    sent: bool
    values: Mapping[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class ObstaclePoints:
    """Points (N, 3) of one keyframe, camera frame, in which obstacles are looked for from then on.

    `t_ns` is the time of the keyframe, whose points before they replace.
    """

    t_ns: int
    keyframe_id: int
    points_camera: Floats


@dataclass(frozen=True, slots=True)
class HealthNote:
    """Health of the daemon: status document, state of the clock filter, origin if known."""

    t_ns: int
    document: Mapping[str, Any]


FlightNote = LinkBytes | GateStep | ObstaclePoints | HealthNote
