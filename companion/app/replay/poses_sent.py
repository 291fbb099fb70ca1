"""Poses that an autopilot would have been sent in a replayed flight, by the gate of a live one."""

from __future__ import annotations

from pathlib import Path

from companion.config import Config
from companion.estimation.gate.pose_gate import PoseGate
from companion.estimation.gate.pose_to_send import PoseToSend
from companion.messages import Message, Odometry
from companion.products.atomic_file import write_atomically
from companion.products.trajectory_file import sent_poses_tum
from companion.telemetry import AttitudeSample

POSES_SENT = "poses_sent.tum"


class PosesSent:
    """Passes odometry and attitudes to a pose gate as they come, and keeps what it lets through.

    Time is that of the messages: a computer that needs none for its work. Nothing is corrected
    afterwards.
    """

    def __init__(self, config: Config) -> None:
        self._gate = PoseGate(config.feedback, use=config.telemetry.use)
        self.poses: list[PoseToSend] = []

    def take(self, message: Message) -> None:
        """Take a message of any kind, in the order of a replay."""
        if isinstance(message, AttitudeSample):
            self._predict_until(message.t_ns)
            self._gate.take_attitude(message)
        elif isinstance(message, Odometry):
            self._predict_until(message.t_ns - 1)
            pose = self._gate.take(message, message.t_ns)
            if pose is not None:
                self.poses.append(pose)

    def write(self, folder: Path) -> None:
        """Write `poses_sent.tum`."""
        lines = sent_poses_tum((p.t_ns, p.world_from_body) for p in self.poses)
        write_atomically(folder / POSES_SENT, lines)

    def _predict_until(self, t_ns: int) -> None:
        """Poses that are due between frames."""
        while (due_ns := self._gate.due_ns) is not None and due_ns <= t_ns:
            pose = self._gate.due(due_ns)
            if pose is not None:
                self.poses.append(pose)
