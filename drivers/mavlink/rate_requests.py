"""Requests of the autopilot's messages at their rates, one after the other, and what it refuses."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import LinkConfig
from companion.doctor.imu_room import imu_room
from companion.messages import Warned
from companion.timing.clock import FlightClock
from drivers.mavlink.commands import NO_ANSWER, REFUSALS
from drivers.mavlink.imu_rate import ImuNews, ImuRate
from drivers.mavlink.message_rates import MessageRates
from drivers.mavlink.wire.message_port import MavlinkPort
from drivers.system.ticks import tick
from drivers.telemetry.mavlink_samples import wanted

PAUSE_S = 0.1
Request = Callable[[int, float], Awaitable[int]]
"""Requests a message at an interval, us: a MAV_RESULT, or NO_ANSWER."""


class RateRequests:
    """Keeps the messages that make samples coming, and the IMU's as often as the link carries."""

    def __init__(
        self, config: LinkConfig, port: MavlinkPort, clock: FlightClock,
        warn: Callable[[Warned], None], request: Request, on_gimbal: bool,
    ) -> None:  # fmt: skip
        self._config, self._port, self._clock = config, port, clock
        self._warn, self._request = warn, request
        self._rates = MessageRates(wanted(config, on_gimbal))
        self._imu = ImuRate() if config.imu_hz == "auto" else None
        self._refused: set[int] = set()
        self._said_of_imu = ""

    async def run(self, firmware: Callable[[], str | None]) -> None:
        """Request what is due; `firmware` is None while the autopilot is not heard."""
        while True:
            now_ns, heard = self._clock.now_ns(), firmware()
            if heard is None:
                self._rates.skip(now_ns)
            elif (due := self._rates.due(now_ns)) is not None:
                await self._ask_for(*due)
                continue
            elif self._imu is not None:
                room = imu_room(self._config, self._port.capacity_bytes_per_s, heard)
                self._tell_of_imu(self._imu.step(self._rates, room), now_ns)
            await tick(PAUSE_S)

    def came(self, message_id: int, is_sample: bool) -> None:
        """Count a message; those that make samples have a rate to keep."""
        if self._imu is not None:
            self._imu.heard(message_id)
        if is_sample:
            self._rates.came(message_id)

    def restart(self, rebooted: bool) -> None:
        """Request everything anew, after a silence or a reboot."""
        self._rates.restart()
        if self._imu is not None:
            self._imu.restart(rebooted)

    def __str__(self) -> str:
        return str(self._imu or "")

    async def _ask_for(self, message_id: int, rate_hz: float) -> None:
        """Request a message at a rate; at 0, what the autopilot sends by itself."""
        result = await self._request(message_id, 1e6 / rate_hz if rate_hz else 0.0)
        if result == NO_ANSWER and not rate_hz:
            await tick(PAUSE_S)
            return
        now_ns = self._clock.now_ns()
        refused = result in REFUSALS
        self._rates.asked(message_id, refused, now_ns)
        if refused and self._imu is not None and message_id in self._imu.ids:
            self._tell_of_imu(self._imu.refused(message_id), now_ns)
        elif refused and message_id not in self._refused:
            self._refused.add(message_id)
            name = mavlink.mavlink_map[message_id].msgname
            self._warn(Warned(now_ns, "autopilot does not send a message", name))
        if result == NO_ANSWER:
            await tick(PAUSE_S)

    def _tell_of_imu(self, news: ImuNews | None, now_ns: int) -> None:
        if news is not None and news.detail != self._said_of_imu:
            self._said_of_imu = news.detail
            self._warn(Warned(now_ns, news.what, news.detail))
