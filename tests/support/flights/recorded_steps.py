"""Steps of a gate's journal, as they come back from a recording."""

from __future__ import annotations

from companion.flight_notes import GateStep
from drivers.recording.decisions import step_of
from drivers.recording.recording_codec import decision_bytes


def recorded(step: GateStep) -> GateStep:
    """A step after it was recorded."""
    return step_of(step.t_ns, decision_bytes(step))
