"""Rate of the IMU to request: what fits the link, and less where less comes or others suffer.

It begins when the other messages have been measured without it. From then on it only goes down, by
a fifth or more each time, and below 50 Hz to nothing: so it settles after a few steps. A reboot of
the autopilot begins anew.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.doctor.imu_room import LEAST_HZ, ImuRoom, in_whole_ms
from drivers.mavlink.message_rates import MessageRates
from drivers.telemetry.mavlink_samples import IMU_REQUESTS, Wanted

SHORT = 0.8
"""Share of a rate below which it counts as markedly less."""
WINDOWS = 2
"""Windows in a row that must be short, since one may be by chance."""
BULK = frozenset({
    mavlink.MAVLINK_MSG_ID_PARAM_VALUE, mavlink.MAVLINK_MSG_ID_MISSION_REQUEST,
    mavlink.MAVLINK_MSG_ID_MISSION_REQUEST_INT, mavlink.MAVLINK_MSG_ID_LOG_DATA,
    mavlink.MAVLINK_MSG_ID_FILE_TRANSFER_PROTOCOL,
})  # fmt: skip
"""While a ground station is sent such, ArduPilot slows all streams to a quarter or less."""
MOST_BULK = 5
"""Of them in a window that is judged."""
NO_IMU = "the autopilot is not asked for its IMU"
FEWER = "the autopilot's IMU is asked for less often"

Shares = Mapping[int, float]
"""Measured over requested rate, at most 1, by message."""


@dataclass(frozen=True, slots=True)
class ImuNews:
    """Change of the rate, in words."""

    what: str
    detail: str


class ImuRate:
    """Decides, asks no clock and sends nothing itself."""

    def __init__(self) -> None:
        self.ids: tuple[int, ...] = IMU_REQUESTS
        self.asked_hz = 0.0
        self.came_hz: float | None = None
        """Measured; None before the first window."""
        self.why = ""
        """Reason why none is requested."""
        self.begun = False
        self._carried_hz = math.inf
        self._others: Shares = {}
        self._n_short = self._n_bulk = 0

    @property
    def want(self) -> Wanted:
        """Request now; a rate of 0 leaves it to the autopilot."""
        return Wanted(self.ids, self.asked_hz)

    def restart(self, rebooted: bool) -> None:
        """Begin anew; what the link was found to carry is forgotten at a reboot only."""
        self.begun, self.asked_hz, self.came_hz, self.why = False, 0.0, None, ""
        if rebooted:
            self._carried_hz = math.inf

    def step(self, rates: MessageRates, room: ImuRoom) -> ImuNews | None:
        """Take what was measured, and change what is requested; to be called often."""
        others, before_hz = rates.shares(), self.asked_hz
        if others is None:
            return None
        news = None
        if not self.begun:
            news = self.begin(room, others)
        elif (came_hz := rates.take_window(self.ids)) is not None:
            news = self.judge(came_hz, others)
        if self.asked_hz != before_hz:
            rates.change(self.want)
        return news

    def begin(self, room: ImuRoom, others: Shares) -> ImuNews | None:
        """Choose the rate, when the others' shares without the IMU are known."""
        begin = 0 if mavlink_id(room.message) == IMU_REQUESTS[0] else 1
        self.begun, self.ids, self._others = True, IMU_REQUESTS[begin:], dict(others)
        self._n_short = self._n_bulk = 0
        if room.rate_hz == 0:
            self.why = room.why
        else:
            self._ask(min(room.rate_hz, self._carried_hz))
            if not self.asked_hz:
                self.why = "the link did not carry it before"
        return ImuNews(NO_IMU, self.why) if self.why else None

    def refused(self, message_id: int) -> ImuNews | None:
        """Take a refusal of a message for good; another stands in for all but the last."""
        if message_id != self.ids[-1]:
            return None
        self.asked_hz, self.why = 0.0, "it has no message for it"
        return ImuNews(NO_IMU, self.why)

    def heard(self, message_id: int) -> None:
        """Count a message of any kind."""
        if message_id in BULK:
            self._n_bulk += 1

    def judge(self, came_hz: float, others: Shares) -> ImuNews | None:
        """Take a window's rate, and the newest shares of the others; news where that changes it."""
        self.came_hz = came_hz
        is_bulk, self._n_bulk = self._n_bulk > MOST_BULK, 0
        slowed = any(others.get(each, 1.0) < SHORT * alone for each, alone in self._others.items())
        short = came_hz < SHORT * self.asked_hz
        if is_bulk or came_hz == 0 or not self.asked_hz or not (slowed or short):
            self._n_short = 0  # nothing at all is a request that was lost: it is repeated
            return None
        self._n_short += 1
        if self._n_short < WINDOWS:
            return None
        self._n_short = 0
        before_hz = self.asked_hz
        self._ask(min(came_hz if short else before_hz, before_hz / 2 if slowed else before_hz))
        self._carried_hz = self.asked_hz
        found = f"{came_hz:.0f} of {before_hz:.0f} Hz came"
        if slowed:
            found += ", and other messages became fewer"
        if self.asked_hz:
            return ImuNews(FEWER, f"{found}: {self.asked_hz:.0f} Hz from now on")
        self.why = f"{found}; the scale by accelerometers needs {LEAST_HZ:.0f} Hz"
        return ImuNews(NO_IMU, self.why)

    def __str__(self) -> str:
        if self.asked_hz:
            came = "" if self.came_hz is None else f"{self.came_hz:.0f} of "
            return f"IMU {came}{self.asked_hz:.0f} Hz"
        return f"no IMU: {self.why}" if self.why else ""

    def _ask(self, rate_hz: float) -> None:
        self.asked_hz = in_whole_ms(rate_hz) if rate_hz >= LEAST_HZ else 0.0


def mavlink_id(name: str) -> int:
    """Number of a message."""
    return int(getattr(mavlink, f"MAVLINK_MSG_ID_{name}"))
