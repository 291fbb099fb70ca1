"""Notes of a flight beside its measurements: bytes of the link, steps of the pose gate, health.

They go to the recording, for a replay as flown.
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
class LinkReads:
    """Bytes of the link in a row, in one message; `t_ns` is the time of the first."""

    t_ns: int
    parts: tuple[LinkBytes, ...]


@dataclass(frozen=True, slots=True)
class GateStep:
    """One call of the pose gate, with its inputs; see `estimation.gate_journal`.

    `t_ns` is the time of the call, `n_attitudes` the number of attitudes since the begin of the
    flight. `counter` is the reset counter afterwards; `counter_sent` is True once this boot of the
    autopilot was sent a pose, `sent` if the autopilot was heard, so that a pose of this call went
    out.
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
