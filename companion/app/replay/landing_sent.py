"""Positions of the landing marker that an autopilot would have been sent in a replayed flight."""

from __future__ import annotations

from pathlib import Path

from companion.config import Config
from companion.estimation.landing.landing_gate import LandingGate
from companion.messages import LandingTarget, Message
from companion.products.atomic_file import write_atomically
from companion.telemetry import AttitudeSample

LANDING_SENT = "landing_sent.csv"
HEADER = "t_ns,forward_m,right_m,down_m,north_m,east_m,ned_down_m"


class LandingSent:
    """Passes landing targets and attitudes to the gate of a live flight; see `PosesSent`."""

    def __init__(self, config: Config) -> None:
        self._gate = LandingGate(config.telemetry.use)
        self.lines = [HEADER]

    def take(self, message: Message) -> None:
        """Take a message of any kind, in the order of a replay."""
        if isinstance(message, AttitudeSample):
            self._gate.take_attitude(message)
        elif isinstance(message, LandingTarget):
            found = self._gate.take(message, message.t_ns)
            if found is not None:
                metres = [*found.position_body_m.tolist(), *found.offset_ned_m.tolist()]
                self.lines.append(",".join([str(found.t_ns), *(f"{each:.4f}" for each in metres)]))

    def write(self, folder: Path) -> None:
        """Write `landing_sent.csv`."""
        write_atomically(folder / LANDING_SENT, ("\n".join(self.lines) + "\n").encode())
