"""Choice of the EKF's source set by the verdict on satellites: theirs, or that of vision.

It is changed to vision while poses are sent only: else the EKF would be left with nothing. A doubt
outlives its flight in the air, where what begins anew knows nothing of it, and ends on the ground.
"""

from __future__ import annotations

from companion.config import GpsConfig

AGAIN_NS = 5_000_000_000
"""Interval of tries after a refusal."""


class SourceChoice:
    """Decides which set to ask the autopilot for; time is that of each call."""

    def __init__(self, config: GpsConfig) -> None:
        self._config = config
        self.doubted = False
        """True while satellites are doubted."""
        self.of_this_flight = False
        """True if the current flight has the doubt."""
        self.on_vision: bool | None = False
        """True while the EKF is on the set without satellites, by our command; None where that is
        not known: a command without an answer may have been obeyed, a reboot forgets it."""
        self.not_before_ns = 0

    def begin_flight(self) -> None:
        """Another flight begins, which doubts nothing yet."""
        self.of_this_flight = False

    def doubt_satellites(self, doubted: bool) -> None:
        """Satellites are doubted, or are not any more."""
        self.doubted = self.of_this_flight = doubted

    def autopilot_booted(self) -> None:
        """The autopilot has come up with its first set."""
        if self.on_vision:
            self.on_vision = None

    def due(self, now_ns: int, armed: bool, sends_poses: bool) -> int | None:
        """The set to ask a listening ArduPilot for now; None without a change."""
        if self.doubted and not armed:
            self.doubted = self.of_this_flight
        if self.doubted == self.on_vision or now_ns < self.not_before_ns:
            return None
        if self.doubted:
            return self._config.vision_set if sends_poses else None
        return self._config.satellites_set

    def answered(self, to_vision: bool, accepted: bool | None, now_ns: int) -> None:
        """Take the answer to a change; None where there was none."""
        if accepted:
            self.on_vision = to_vision
            return
        if accepted is None:
            self.on_vision = None
        self.not_before_ns = now_ns + AGAIN_NS
