"""Switches the sources of ArduPilot's EKF while satellites are doubted, where that is allowed.

It is done while poses are sent only: else the EKF would be left with nothing. A doubt outlives its
flight in the air, where what begins anew knows nothing of it, and ends on the ground. Runs in the
event loop.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from companion.config import GpsConfig
from companion.messages import Warned
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink

TICK_S, AGAIN_NS = 0.1, 5_000_000_000
"""Interval of looks, and of tries after a refusal."""
TO_VISION = "the EKF's sources are switched to vision"
TO_SATELLITES = "the EKF's sources are switched to satellites"
ACCEPTED = 0
"""MAV_RESULT."""
NOT_SWITCHED = "the EKF's sources could not be switched"


class SourceSwitch:
    """Changes the EKF source set by the verdict on satellites.

    `sending` is True with poses, `flight` gives the current flight, None without one.
    """

    def __init__(
        self,
        config: GpsConfig,
        link: AutopilotLink,
        clock: FlightClock,
        sending: Callable[[], bool],
        flight: Callable[[], object],
        warn: Callable[[Warned], None],
    ) -> None:
        self._config, self._link, self._clock = config, link, clock
        self._sending, self._flight, self._warn = sending, flight, warn
        self._doubted = False
        self._doubted_in: object = None
        """Flight that has the doubt."""
        self._switched: bool | None = False
        """True while the EKF is on the set without satellites, by our command; None where that is
        not known: a command without an answer may have been obeyed, a reboot forgets it."""
        self._n_reboots = link.clock_filter.n_reboots
        self._not_before_ns = 0

    def doubt_satellites(self, doubted: bool) -> None:
        """Satellites are doubted, or are not any more."""
        self._doubted, self._doubted_in = doubted, self._flight() if doubted else None

    async def run(self) -> None:
        """Switch when due; until cancelled."""
        while True:
            await asyncio.sleep(TICK_S)
            await self.step()

    async def step(self) -> None:
        """Switch if due."""
        now_ns, vehicle = self._clock.now_ns(), self._link.vehicle
        if self._doubted and vehicle is not None and not vehicle.armed:
            self._doubted = self._flight() is self._doubted_in
        if self._n_reboots != self._link.clock_filter.n_reboots:
            self._n_reboots = self._link.clock_filter.n_reboots
            self._switched = None if self._switched else self._switched
        if self._doubted == self._switched or now_ns < self._not_before_ns:
            return
        if vehicle is None or vehicle.firmware != "ardupilot" or not self._link.alive:
            return
        to_vision = self._doubted
        if to_vision and not self._sending():
            return
        number = self._config.vision_set if to_vision else self._config.satellites_set
        result = await self._link.set_source_set(number)
        if result == ACCEPTED:
            self._switched = to_vision
            what = TO_VISION if to_vision else TO_SATELLITES
            self._warn(Warned(self._clock.now_ns(), what, f"set {number}", good=not to_vision))
            return
        if result < 0:
            self._switched = None
        self._not_before_ns = self._clock.now_ns() + AGAIN_NS
        detail = f"set {number}: MAV_RESULT {result}" if result >= 0 else f"set {number}: no answer"
        self._warn(Warned(self._clock.now_ns(), NOT_SWITCHED, detail))
