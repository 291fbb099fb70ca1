"""Link to the autopilot: discovery, clock synchronisation, message rates, samples.

Its HEARTBEAT identifies the vehicle; from then on we are a component of that system. Its
measurements are passed on as samples on the flight's clock. Every failure of the link is reported
once and handled when it is over.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections import defaultdict
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import FeedbackConfig, LinkConfig
from companion.doctor.line_rate import FULL, sent_bytes_per_s
from companion.geometry.geodesy import GeoOrigin
from companion.health import SourceHealth
from companion.messages import Warned
from companion.meters import RateMeter, SourceMeter
from companion.pilot_messages import PilotText
from companion.telemetry import ArmedSample, LandedSample, Telemetry
from companion.timing.clock import FlightClock
from companion.timing.link_clock import ClockFilter
from drivers.mavlink.clock_exchange import ClockExchange
from drivers.mavlink.commands import ANSWER_S, AUTOPILOT, REFUSALS, Commands
from drivers.mavlink.other_companion import OtherCompanion
from drivers.mavlink.rate_requests import RateRequests
from drivers.mavlink.status_text import TextLimit, status_text
from drivers.mavlink.vehicle import Firmware, Vehicle, is_autopilot, vehicle_of
from drivers.mavlink.wire.message_port import MavlinkPort
from drivers.mavlink.wire.wire import run_together
from drivers.system.ticks import tick
from drivers.system.within import within
from drivers.telemetry.gimbal_messages import GIMBAL_IDS
from drivers.telemetry.live_samples import LiveSamples
from drivers.telemetry.mavlink_samples import READERS, landed, takes_biases_off

FIRST_SYSTEM = 1
"""System id that we use until the vehicle is heard: on UDP it may send only then."""
HEARTBEAT_NS, HEARTBEAT_TICK_S = 1_000_000_000, 0.05
WATCH_S, ORIGIN_S = 0.1, 5.0
REQUEST_S = 0.4
TIMESYNC_S = 0.1
"""Interval of requests, as PX4's own."""
COUNTED = {
    *READERS, *GIMBAL_IDS, mavlink.MAVLINK_MSG_ID_HEARTBEAT, mavlink.MAVLINK_MSG_ID_SYSTEM_TIME,
}  # fmt: skip

Take = Callable[[Any, int], None]


class AutopilotLink:
    """One vehicle's autopilot. Used from one event loop; `deliver` and `warn` are called in it."""

    def __init__(
        self,
        config: LinkConfig,
        port: MavlinkPort,
        clock: FlightClock,
        deliver: Callable[[Telemetry], None],
        warn: Callable[[Warned], None],
        on_gimbal: bool = False,
    ) -> None:
        self._config, self.port, self._clock = config, port, clock
        self._deliver, self._warn = deliver, warn
        self.vehicle: Vehicle | None = None
        """None until its first HEARTBEAT; kept while it is silent."""
        self.alive = False
        """True while the autopilot is heard."""
        self.clock_filter = ClockFilter()
        self._clocks = ClockExchange(clock, self.clock_filter, self.send, lambda: port.identity)
        self.samples = LiveSamples(self.clock_filter, deliver, warn)
        self._meter = SourceMeter("autopilot")
        self._rates: defaultdict[str, RateMeter] = defaultdict(RateMeter)
        self._requests = RateRequests(config, port, clock, warn, self._request_rate, on_gimbal)
        self.commands = Commands(self.send, self._target)
        self._text_limit = TextLimit()
        self.system_status: int = mavlink.MAV_STATE_BOOT
        """MAV_STATE of our HEARTBEAT."""
        self.sends_poses = False
        """True where this companion may send any: its HEARTBEAT tells others."""
        self.other_companion = OtherCompanion()
        self.on_request: Take | None = None
        """Handler of all messages, for requests to our component."""
        self.on_camera_request: Take | None = None
        """The same for requests to the component that is our camera."""
        self._takers: defaultdict[int, list[Take]] = defaultdict(list)
        self._heard_ns = 0
        self._armed: bool | None = None
        self._n_reboots = 0
        self._strangers: set[int] = set()
        port.identity = (config.system_id or FIRST_SYSTEM, config.component_id)
        self._on: dict[int, Take] = {
            mavlink.MAVLINK_MSG_ID_HEARTBEAT: self._take_heartbeat,
            mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: self._take_landed,
            mavlink.MAVLINK_MSG_ID_TIMESYNC: self._clocks.take,
            mavlink.MAVLINK_MSG_ID_COMMAND_ACK: self._take_acknowledgement,
        }

    async def run(self) -> None:
        """Serve the link until cancelled."""
        await run_together(
            self.port.run(self._take),
            self._say_heartbeats(),
            self._compare_clocks(),
            self._watch(),
            self._requests.run(self._firmware),
            self._ask_for_origin(),
        )

    # -- what others ask -------------------------------------------------------------------------

    @property
    def rates_hz(self) -> dict[str, float]:
        """Measured rates of messages that make samples, by name, over the last seconds."""
        now_ns = self._clock.now_ns()
        found = {name: round(meter.hz(now_ns), 1) for name, meter in sorted(self._rates.items())}
        return {name: rate_hz for name, rate_hz in found.items() if rate_hz}

    @property
    def origin(self) -> GeoOrigin | None:
        """Origin of the positions passed on; None while unknown."""
        return self.samples.positions.home

    @property
    def health(self) -> SourceHealth:
        """Health now."""
        self._meter.n_dropped = sum(self.samples.n_dropped.values())
        self._meter.detail = self._detail()
        if self.alive:
            self._meter.state = "running"
        elif self._meter.n:
            self._meter.state = "silent"
        else:
            self._meter.state = "opening" if self.port.connected else "missing"
        return self._meter.health(self._clock.now_ns())

    def listen(self, message_id: int, take: Take) -> Callable[[], None]:
        """Call back with every message of a type from the autopilot; call the result to stop."""
        self._takers[message_id].append(take)

        def end() -> None:
            with contextlib.suppress(ValueError):
                self._takers[message_id].remove(take)

        return end

    def carries(self, feedback: FeedbackConfig, camera_hz: float) -> bool:
        """False of a serial line that is filled by what is to be sent: it would come too late."""
        room = self.port.capacity_bytes_per_s
        sent = sent_bytes_per_s(self._config, feedback, feedback.mode, camera_hz)
        return room is None or sent <= FULL * room

    # -- what goes out ---------------------------------------------------------------------------

    def send(self, message: Any) -> None:
        """Send a message as our component; never waits, never fails."""
        self.port.send(message)

    def heartbeat(self) -> Any:
        """Our HEARTBEAT now."""
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0,
            self.other_companion.mark if self.sends_poses else 0, self.system_status, 3,
        )  # fmt: skip

    def say(self, text: PilotText) -> bool:
        """Send a STATUSTEXT to the pilot. False where the rate limit held it back."""
        said = self._text_limit.passed(text, self._clock.now_ns())
        for each in said:
            self.send(status_text(each))
        return bool(said)

    async def request_message(self, message_id: int) -> Any | None:
        """Request a message that is not streamed; None if it does not come."""
        came: asyncio.Future[Any] = asyncio.get_running_loop().create_future()

        def take(message: Any, _receive_ns: int) -> None:
            if not came.done():
                came.set_result(message)

        end = self.listen(message_id, take)
        try:
            result = await self.commands.long(mavlink.MAV_CMD_REQUEST_MESSAGE, message_id)
            if result in REFUSALS and not came.done():
                return None
            with contextlib.suppress(asyncio.TimeoutError):
                return await within(came, ANSWER_S)
            return None
        finally:
            end()

    # -- what comes in ---------------------------------------------------------------------------

    def _take(self, message: Any, receive_ns: int) -> None:
        system, component = message.get_srcSystem(), message.get_srcComponent()
        kind = message.get_msgId()
        for take in (self.on_request, self.on_camera_request):
            if take is not None:
                take(message, receive_ns)
        if kind == mavlink.MAVLINK_MSG_ID_HEARTBEAT and is_autopilot(message):
            if not self._is_ours(system, receive_ns):
                return
            if self.vehicle is None:
                self._found(vehicle_of(message), receive_ns)
        vehicle = self.vehicle
        if vehicle is None or system != vehicle.system_id:
            return
        if component != AUTOPILOT:
            if self.other_companion.take(message, self.port.identity, receive_ns):
                detail = f"component {component} of the same system sends poses"
                self._warn(Warned(receive_ns, "another companion on the link", detail))
            if kind in GIMBAL_IDS:
                self.samples.take_gimbal(message, receive_ns)
            return
        self._heard(receive_ns)
        self._requests.came(kind, kind in COUNTED)
        if kind in COUNTED:
            self._rates[message.get_type()].add(receive_ns)
        own = self._on.get(kind)
        if own is not None:
            own(message, receive_ns)
        else:
            self.samples.take(message, receive_ns)
        for take in tuple(self._takers.get(kind, ())):
            take(message, receive_ns)
        if self.clock_filter.n_reboots != self._n_reboots:
            self._rebooted(receive_ns)

    def _is_ours(self, system: int, now_ns: int) -> bool:
        ours = self._config.system_id or (self.vehicle.system_id if self.vehicle else system)
        if system == ours:
            return True
        if system not in self._strangers:
            self._strangers.add(system)
            detail = f"system {system} is ignored; ours is {ours}"
            self._warn(Warned(now_ns, "another vehicle on the link", detail))
        return False

    def _found(self, vehicle: Vehicle, now_ns: int) -> None:
        self.vehicle = vehicle
        self.port.identity = (vehicle.system_id, self._config.component_id)
        self._warn(Warned(now_ns, "autopilot found", f"{vehicle} on {self.port.name}", good=True))

    def _heard(self, now_ns: int) -> None:
        if not self.alive and self._heard_ns:
            silent_s = (now_ns - self._heard_ns) * 1e-9
            detail = f"after {silent_s:.1f} s"
            self._warn(Warned(now_ns, "autopilot heard again", detail, good=True))
            self._meter.n_reopened += 1
            self._requests.restart(rebooted=False)
        self.alive = True
        self._heard_ns = max(self._heard_ns, now_ns)
        self._meter.came(now_ns)

    def _take_heartbeat(self, message: Any, receive_ns: int) -> None:
        if not is_autopilot(message):
            return
        self.vehicle = vehicle_of(message)
        self.samples.less_biases = takes_biases_off(message)
        if self.vehicle.armed is not self._armed:
            self._armed = self.vehicle.armed
            self._deliver(ArmedSample(receive_ns, self._armed))

    def _take_landed(self, message: Any, receive_ns: int) -> None:
        self._deliver(LandedSample(receive_ns, landed(message)))

    def _take_acknowledgement(self, message: Any, _receive_ns: int) -> None:
        self.commands.answered(message, self.port.identity)

    def _rebooted(self, now_ns: int) -> None:
        self._n_reboots = self.clock_filter.n_reboots
        self._clocks.restart()
        self._requests.restart(rebooted=True)
        self._warn(Warned(now_ns, "autopilot rebooted", "its boot time went back"))

    # -- what is done in turn --------------------------------------------------------------------

    async def _say_heartbeats(self) -> None:
        """Send once a second, and at once under a new name or on a new wire."""
        said_as: tuple[int, int] | None = None
        due_ns = 0
        while True:
            now_ns = self._clock.now_ns()
            if not self.port.connected:
                said_as = None
            elif said_as != self.port.identity or now_ns >= due_ns:
                said_as, due_ns = self.port.identity, now_ns + HEARTBEAT_NS
                self.send(self.heartbeat())
            await tick(HEARTBEAT_TICK_S)

    async def _compare_clocks(self) -> None:
        while True:
            if self.vehicle is not None:
                self._clocks.ask(self.vehicle.system_id)
            await tick(TIMESYNC_S)

    async def _watch(self) -> None:
        while True:
            await tick(min(WATCH_S, self._config.silent_after_s / 4))
            now_ns = self._clock.now_ns()
            silent_s = (now_ns - self._heard_ns) * 1e-9
            if self.alive and silent_s > self._config.silent_after_s:
                self.alive = False
                where = "" if self.port.connected else f", {self.port.name} is not connected"
                detail = f"nothing for {silent_s:.1f} s{where}"
                self._warn(Warned(now_ns, "autopilot silent", detail))

    async def _request_rate(self, message_id: int, interval_us: float) -> int:
        return await self.commands.long(
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, interval_us,
            timeout_s=REQUEST_S, tries=2,
        )  # fmt: skip

    def _firmware(self) -> Firmware | None:
        """Firmware of the autopilot; None while it is not heard."""
        return self.vehicle.firmware if self.alive and self.vehicle else None

    async def _ask_for_origin(self) -> None:
        """Request the origin: it is sent once, possibly before we listened."""
        while True:
            await asyncio.sleep(ORIGIN_S if self.alive else WATCH_S)
            if self.alive and self.samples.positions.origin is None:
                await self.request_message(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)

    def _target(self) -> int:
        return self.vehicle.system_id if self.vehicle else self._config.system_id

    def _detail(self) -> str:
        if self.port.trouble:
            return self.port.trouble
        if self.vehicle is None:
            return ""
        report = self.clock_filter.report()
        clock = "clock not known" if report is None else f"clock ±{report.sigma_ms:.1f} ms"
        parts = [str(self.vehicle), clock, str(self._requests)]
        return ", ".join(part for part in parts if part)
