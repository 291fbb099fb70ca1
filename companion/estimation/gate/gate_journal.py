"""Journal of the gates: inputs, from which what was sent to the autopilot can be computed again.

A gate decides by the time of each call and by what its caller knows then of the autopilot. The
journal has these, in their order among the samples that the gate takes; calls without effect are
left out.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Protocol

from companion.flight_notes import GateStep
from companion.telemetry import Telemetry

POSE, LANDING, GLOBAL, SOURCES, FLOW = "pose", "landing", "global", "sources", "flow"
"""Gates: poses, landing targets, global positions, source sets of the EKF, optical flow."""
OBSTACLES = "obstacles"
"""Rounds of obstacles: see `companion.daemon.obstacle_reports`."""
BEGIN = "begin"
Takes = Mapping[type, Callable[[Any], None]]
"""Methods that take samples, by the kinds of those that count."""


class GateJournal:
    """Journal of one gate, passed to `tell` step by step; call `begin` with each flight."""

    def __init__(self, gate: str, tell: Callable[[GateStep], None]) -> None:
        self._gate, self._tell = gate, tell
        self._n_samples = 0

    def begin(self, now_ns: int, values: Mapping[str, object]) -> None:
        """Begin with a flight, and its recording; `values` are what the gate knows from before."""
        self._n_samples = 0
        self.step(BEGIN, now_ns, values)

    def sample(self) -> None:
        """The gate takes a sample; one that is not believed counts, too."""
        self._n_samples += 1

    def step(
        self, what: str, now_ns: int, values: Mapping[str, object], sent: bool = False
    ) -> None:
        """A call, with its inputs; `sent` if what it gave goes out."""
        self._tell(GateStep(now_ns, self._gate, what, self._n_samples, sent, values))


class GateAgain(Protocol):
    """A gate that is asked again, by its journal."""

    takes: Takes

    def ask(self, step: GateStep) -> object | None:
        """Repeat a call; what it gives to be sent, if anything."""


def given_again(
    gates: Mapping[str, GateAgain], steps: Iterable[GateStep], samples: Iterable[Telemetry]
) -> Iterator[tuple[GateStep, object]]:
    """All that gates give to be sent, by their journals, from the beginning of a flight."""
    samples = list(samples)
    waiting = {
        name: deque(sample for sample in samples if type(sample) in gate.takes)
        for name, gate in gates.items()
    }
    n_taken = dict.fromkeys(gates, 0)
    for step in steps:
        gate = gates[step.gate]
        while n_taken[step.gate] < step.n_samples and waiting[step.gate]:
            sample = waiting[step.gate].popleft()
            gate.takes[type(sample)](sample)
            n_taken[step.gate] += 1
        given = gate.ask(step)
        if given is not None:
            yield step, given
