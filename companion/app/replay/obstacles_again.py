"""Obstacles, looked for again by their journal: what the autopilot was sent of them."""

from __future__ import annotations

from collections import deque

from companion.daemon.obstacle_reports import ROUND
from companion.estimation.gate.gate_journal import OBSTACLES
from companion.geometry.camera import Camera
from companion.messages import Frame, MapUpdate, Message, Track
from companion.obstacles.obstacle_finder import ObstacleFinder
from drivers.mavlink.measurements.obstacle_distance import obstacle_messages
from drivers.recording.decisions import Decisions, payloads_of


class ObstaclesAgain:
    """Frames and output of localisation in, in their order; makes each round when it is due."""

    def __init__(self, told: Decisions, camera: Camera) -> None:
        self._finder = ObstacleFinder(camera)
        self._rounds = deque(
            step for step in told.gates if step.gate == OBSTACLES and step.what == ROUND
        )
        self._parts = told.obstacle_points
        self._n_taken = self._n_parts = 0
        self.payloads: list[tuple[int, bytes]] = []
        """Id and payload of each message."""
        self._look()

    def frame(self, frame: Frame) -> None:
        """Take a frame."""
        self._finder.frame(frame)

    def take(self, message: Message) -> None:
        """Take an output of localisation."""
        if isinstance(message, Track | MapUpdate):
            self._finder.take(message)
            self._n_taken += 1
            self._look()

    def _look(self) -> None:
        """Make the rounds that were made before anything else came."""
        while self._rounds and self._rounds[0].values["n_taken"] <= self._n_taken:
            step = self._rounds.popleft()
            by = step.values
            parts = self._parts[self._n_parts : by["n_parts"]]
            self._n_parts = by["n_parts"]
            given = self._finder.round(step.t_ns, with_image=by["has_image"])
            found = self._finder.look(given, parts, by["reach_m"])
            if step.sent:
                messages = obstacle_messages(found, step.t_ns, in_space=by["reach_m"] is None)
                self.payloads += payloads_of(messages)
