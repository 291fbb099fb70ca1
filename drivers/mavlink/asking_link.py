"""Link of a command that queries an autopilot: sends heartbeats only.

Beside a running daemon it must not synchronise clocks or request rates; that is the daemon's.
"""

from __future__ import annotations

import asyncio
from collections import defaultdict
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import LinkConfig, RouterConfig
from companion.errors import SourceError
from companion.timing.clock import FlightClock
from drivers.mavlink.vehicle import Vehicle, is_autopilot, vehicle_of
from drivers.mavlink.wire.link_url import link_endpoint
from drivers.mavlink.wire.message_port import MavlinkPort, OnMessage
from drivers.mavlink.wire.pymavlink_port import PymavlinkPort
from drivers.mavlink.wire.serial_wire import SerialWire
from drivers.mavlink.wire.transport import link_wire
from drivers.mavlink.wire.wire import run_together

COMPONENT = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER
"""Not the daemon's, which may be on the link as well."""
AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1
HEARTBEAT_S = 1.0
OPEN_S = 2.0
"""Longest wait for a port to open."""
LOOK_S = 0.02


class AskingLink:
    """Link to one vehicle's autopilot for the duration of a query."""

    def __init__(self, port: MavlinkPort, system_id: int) -> None:
        self.port = port
        self.vehicle: Vehicle | None = None
        self._system_id = system_id
        self._takers: defaultdict[int, list[OnMessage]] = defaultdict(list)

    async def run(self) -> None:
        """Serve the link until cancelled."""
        await run_together(self.port.run(self._take), self._say_heartbeats())

    def send(self, message: Any) -> None:
        """Send a message as our component; never waits, never fails."""
        self.port.send(message)

    def listen(self, message_id: int, take: OnMessage) -> None:
        """Call back with every message of a type from the autopilot."""
        self._takers[message_id].append(take)

    async def found(self, patience_s: float) -> Vehicle:
        """The vehicle, once a heartbeat has come. SourceError if none comes in time."""
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        while self.vehicle is None:
            passed_s = loop.time() - begun_s
            if passed_s > OPEN_S and self.port.trouble and not self.port.connected:
                raise SourceError(f"{self.port.trouble} (link.url is {self.port.name})")
            if passed_s > patience_s:
                trouble = f" ({self.port.trouble})" if self.port.trouble else ""
                raise SourceError(
                    f"{self.port.name}: no autopilot heard in {patience_s:g} s{trouble}; is it "
                    "powered, and is link.url right?"
                )
            await asyncio.sleep(LOOK_S)
        return self.vehicle

    def _take(self, message: Any, t_ns: int) -> None:
        system = message.get_srcSystem()
        if message.get_srcComponent() != AUTOPILOT:
            return
        kind = message.get_msgId()
        ours = self.vehicle.system_id if self.vehicle else self._system_id or system
        if system != ours:
            return
        if kind == mavlink.MAVLINK_MSG_ID_HEARTBEAT and is_autopilot(message):
            self.vehicle = vehicle_of(message)
            self.port.identity = (system, COMPONENT)
        for take in tuple(self._takers.get(kind, ())):
            take(message, t_ns)

    async def _say_heartbeats(self) -> None:
        while True:
            while not self.port.connected:
                await asyncio.sleep(LOOK_S)
            self.send(
                mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0,
                    mavlink.MAV_STATE_ACTIVE, 3,
                )
            )  # fmt: skip
            await asyncio.sleep(HEARTBEAT_S)


@asynccontextmanager
async def asking_link(
    config: LinkConfig, patience_s: float
) -> AsyncIterator[tuple[AskingLink, Vehicle, int]]:
    """A query link, its vehicle and its baud rate, 0 where it has none.

    ConfigError if `link.url` is invalid; SourceError if no autopilot is heard in time.
    """
    wire = link_wire(link_endpoint(config.url))
    asking = replace(config, component_id=COMPONENT)
    port = PymavlinkPort(asking, RouterConfig(), FlightClock(), wire)
    link = AskingLink(port, config.system_id)
    running = asyncio.ensure_future(link.run())
    try:
        vehicle = await link.found(patience_s)
        yield link, vehicle, wire.search.baud if isinstance(wire, SerialWire) else 0
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
