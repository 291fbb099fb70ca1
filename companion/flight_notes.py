"""Notes of a flight beside its measurements: what came over the link, what was decided, health.

They go to the recording, from which the flight can be done again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class LinkBytes:
    """Bytes of the autopilot's wire; `outgoing` are those sent, ours or clients'."""

    t_ns: int
    monotonic_ns: int
    outgoing: bool
    data: bytes


@dataclass(frozen=True, slots=True)
class GateStep:
    """One call of the pose gate, by which its poses can be made again; see `gate_journal`.

    `t_ns` is the time of the call, `n_attitudes` of the autopilot's had come since the flight
    began; `counter` is that of resets afterwards, and whether this boot was sent a pose. `sent`
    tells whether the autopilot was heard, so that a pose was sent.
    """

    t_ns: int
    what: str
    n_attitudes: int
    counter: int
    counter_sent: bool
    sent: bool
    values: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class HealthNote:
    """Health of the daemon: status document, state of the clock filter, origin if known."""

    t_ns: int
    document: Mapping[str, Any]


FlightNote = LinkBytes | GateStep | HealthNote
