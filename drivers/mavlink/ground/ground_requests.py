"""Requests to our component over the link or through the router.

Signing and the router decide who may send them; these have passed. Requests beyond a rate are
ignored, and answers go out at a rate that leaves the link to the poses.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.messages import Warned
from companion.timing.clock import FlightClock
from drivers.mavlink.ground.command_server import CommandServer
from drivers.mavlink.ground.mission_server import MISSIONS, MissionServer
from drivers.mavlink.ground.parameter_server import ParameterServer
from drivers.mavlink.ground.request_limit import request_limit
from drivers.mavlink.wire.message_port import MavlinkPort
from drivers.system.ticks import tick

TICK_S, IDLE_TICK_S = 0.025, 0.05
"""Interval of parameters and waypoints: 1.5 to 2 kB/s; and while none waits."""
WARN_EVERY_NS = 10_000_000_000
TOO_MANY = "more is asked of the companion over MAVLink than it answers"
COMMANDS = (mavlink.MAVLINK_MSG_ID_COMMAND_LONG, mavlink.MAVLINK_MSG_ID_COMMAND_INT)
PARAMETERS = (
    mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_LIST, mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_READ,
    mavlink.MAVLINK_MSG_ID_PARAM_SET,
)  # fmt: skip
PING: int = mavlink.MAVLINK_MSG_ID_PING
KINDS = frozenset({*COMMANDS, *PARAMETERS, *MISSIONS, PING})
EVERYBODY = (0, 0)


class GroundRequests:
    """Handles messages addressed to us, or broadcast; to be used in the event loop."""

    def __init__(
        self,
        port: MavlinkPort,
        clock: FlightClock,
        commands: CommandServer,
        parameters: ParameterServer,
        missions: MissionServer,
        warn: Callable[[Warned], None],
    ) -> None:
        self._port, self._clock, self._warn = port, clock, warn
        self._commands, self._parameters, self._missions = commands, parameters, missions
        self._limit = request_limit()
        self._warned_ns: int | None = None

    def take(self, message: Any, now_ns: int) -> None:
        """Take any message; most are not for us."""
        kind = message.get_msgId()
        if kind not in KINDS:
            return
        target, ours = (message.target_system, message.target_component), self._port.identity
        if target[0] not in (0, ours[0]) or target[1] not in (0, ours[1]):
            return
        if kind == PING and target != EVERYBODY:
            return  # an answer, and we have asked nothing
        asker = message.get_srcSystem(), message.get_srcComponent()
        if not self._limit.allows(asker, now_ns):
            if self._warned_ns is None or now_ns - self._warned_ns > WARN_EVERY_NS:
                self._warned_ns = now_ns
                detail = f"by component {asker[1]} of system {asker[0]}"
                self._warn(Warned(now_ns, TOO_MANY, detail))
            return
        to_all = target != ours
        if kind == PING:
            self._port.send(mavlink.MAVLink_ping_message(message.time_usec, message.seq, *asker))
            return
        if kind in PARAMETERS:
            self._parameters.take(message, to_all)
            return
        if kind in MISSIONS:
            self._missions.take(message, to_all)
            return
        for answer in self._commands.take(message, to_all, now_ns):
            self._port.send(answer)

    async def run(self) -> None:
        """Send answers that wait, until cancelled."""
        waiting = None
        while True:
            await tick(TICK_S if waiting is not None else IDLE_TICK_S)
            for answer in self._commands.step(self._clock.now_ns()):
                self._port.send(answer)
            waiting = self._missions.next_message() or self._parameters.next_message()
            if waiting is not None:
                self._port.send(waiting)
