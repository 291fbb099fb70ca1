"""Parameter protocol, client side: the autopilot's parameters read by name or all, and written.

ArduPilot puts an integer's value into the message's float, PX4 its bytes.
"""

from __future__ import annotations

import asyncio
import math
import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.errors import SourceError
from drivers.mavlink.commands import Commands
from drivers.mavlink.vehicle import Firmware, Vehicle
from drivers.mavlink.wire.message_port import OnMessage
from drivers.system.within import within

AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1
MAVLINK_2 = 0xFD
WINDOW = 10
"""Requests in flight at once; ArduPilot queues no more than 20, of all senders."""
ANSWER_S, LEAST_ANSWER_S = 0.5, 0.1
SLACK = 4
"""A missing parameter is not answered: the timeout is the slowest answer, times this."""
TRIES = 3
MOST_ANSWERS_S = 3.0
MOST_KNOWN = 10_000
STORE, NEITHER = 1.0, -1.0
"""Of MAV_CMD_PREFLIGHT_STORAGE: parameters to flash; missions are left as they are."""
LETTERS = {
    mavlink.MAV_PARAM_TYPE_UINT8: "B", mavlink.MAV_PARAM_TYPE_INT8: "b",
    mavlink.MAV_PARAM_TYPE_UINT16: "H", mavlink.MAV_PARAM_TYPE_INT16: "h",
    mavlink.MAV_PARAM_TYPE_UINT32: "I", mavlink.MAV_PARAM_TYPE_INT32: "i",
    mavlink.MAV_PARAM_TYPE_REAL32: "f",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter as last received; `kind` is a MAV_PARAM_TYPE."""

    name: str
    value: float
    kind: int


class VehicleLink(Protocol):
    """Interface of a link: an AutopilotLink, or an AskingLink."""

    vehicle: Vehicle | None

    def send(self, message: Any) -> None:
        """Send a message as our component."""

    def listen(self, message_id: int, take: OnMessage) -> object:
        """Call back with every message of a type from the autopilot."""


class Parameters:
    """Parameters of the vehicle that a link has found. SourceError before it has found one."""

    def __init__(self, link: VehicleLink) -> None:
        if link.vehicle is None:
            raise SourceError("no autopilot has been heard yet")
        self._send = link.send
        self._system = link.vehicle.system_id
        self._firmware: Firmware = link.vehicle.firmware
        self.known: dict[str, Parameter] = {}
        self._answered: set[str] = set()
        self._unknown: set[str] = set()
        self._came = asyncio.Event()
        self._slowest_s: float | None = None
        self._commands = Commands(link.send, lambda: self._system)
        link.listen(mavlink.MAVLINK_MSG_ID_COMMAND_ACK, self._take_acknowledgement)
        link.listen(mavlink.MAVLINK_MSG_ID_PARAM_VALUE, self._take_value)
        link.listen(mavlink.MAVLINK_MSG_ID_PARAM_ERROR, self._take_error)

    async def read(self, names: Iterable[str]) -> dict[str, Parameter]:
        """Read those of the named that exist. SourceError if the autopilot answers for none."""
        wanted = list(dict.fromkeys(names))
        self._answered.clear()
        self._unknown.clear()
        for _ in range(TRIES):
            missing = [name for name in wanted if not self._settled(name)]
            for at in range(0, len(missing), WINDOW):
                part = missing[at : at + WINDOW]
                for name in part:
                    self._request(name)
                await self._until(partial(self._all_settled, part))
        if wanted and not self._answered and not self._unknown:
            raise SourceError("the autopilot does not answer for its parameters")
        return {name: self.known[name] for name in wanted if name in self._answered}

    async def write(self, name: str, value: float) -> Parameter:
        """Set one that has been read, and read it back. SourceError if the value differs."""
        kind = self.known[name].kind
        for _ in range(TRIES):
            self._answered.discard(name)
            self._send(
                mavlink.MAVLink_param_set_message(
                    self._system, AUTOPILOT, name.encode(), self._encoded(value, kind), kind
                )
            )
            await self._until(lambda: name in self._answered)
            if name in self._answered:
                break
        now = (await self.read([name])).get(name)
        if now is None:
            raise SourceError(f"{name}: the autopilot does not answer")
        if not math.isclose(now.value, value, rel_tol=1e-6, abs_tol=1e-9):
            raise SourceError(f"{name}: the autopilot keeps {now.value:g}, {value:g} was set")
        return now

    async def store(self) -> None:
        """Have what was written outlive a loss of power: PX4 stores it some time later by itself.

        ArduPilot does at once. SourceError if the autopilot does not say that it has.
        """
        if self._firmware != "px4":
            return
        result = await self._commands.long(
            mavlink.MAV_CMD_PREFLIGHT_STORAGE, STORE, NEITHER, timeout_s=MOST_ANSWERS_S, tries=TRIES
        )
        if result != mavlink.MAV_RESULT_ACCEPTED:
            raise SourceError("the autopilot does not say that it has stored its parameters")

    def _take_acknowledgement(self, message: Any, t_ns: int) -> None:
        # whoever asked for it
        self._commands.answered(message, (message.target_system, message.target_component))

    def _take_error(self, message: Any, t_ns: int) -> None:
        if len(self._unknown) < MOST_KNOWN:
            self._unknown.add(message.param_id)
            self._came.set()

    def _take_value(self, message: Any, t_ns: int) -> None:
        value = self._value(message)
        name = message.param_id
        if value is None or (name not in self.known and len(self.known) >= MOST_KNOWN):
            return
        self.known[name] = Parameter(name, value, message.param_type)
        self._answered.add(name)
        self._came.set()

    def _request(self, name: str) -> None:
        self._send(
            mavlink.MAVLink_param_request_read_message(self._system, AUTOPILOT, name.encode(), -1)
        )

    async def _until(self, true: Callable[[], bool]) -> None:
        """Wait for a condition, while each message comes in time; others' come too."""
        loop = asyncio.get_running_loop()
        end_s = loop.time() + MOST_ANSWERS_S
        while not true() and (begin_s := loop.time()) < end_s:
            self._came.clear()
            wait_s = min(self._patience_s, end_s - begin_s)
            try:
                await within(self._came.wait(), wait_s)
            except asyncio.TimeoutError:
                return
            self._slowest_s = max(self._slowest_s or 0.0, loop.time() - begin_s)

    @property
    def _patience_s(self) -> float:
        if self._slowest_s is None:
            return ANSWER_S
        return min(ANSWER_S, max(LEAST_ANSWER_S, SLACK * self._slowest_s))

    def _settled(self, name: str) -> bool:
        return name in self._answered or name in self._unknown

    def _all_settled(self, names: Sequence[str]) -> bool:
        return all(self._settled(name) for name in names)

    def _value(self, message: Any) -> float | None:
        """Value of the message; None for an unknown type."""
        letter = LETTERS.get(message.param_type)
        if letter is None:
            return None
        if self._firmware == "px4" and letter != "f":
            # from the packet, since a float that is no number may not survive being one
            packet = bytes(message.get_msgbuf())
            begin = 10 if packet[0] == MAVLINK_2 else 6
            data = packet[begin : begin + min(4, packet[1])].ljust(4, b"\0")
            return int(struct.unpack_from("<" + letter, data)[0])
        value = float(message.param_value)
        if letter == "f":
            return value
        return round(value) if math.isfinite(value) else None

    def _encoded(self, value: float, kind: int) -> float:
        letter = LETTERS[kind]
        if letter == "f":
            return value
        if self._firmware != "px4":
            return float(round(value))
        data = struct.pack("<" + letter, round(value)).ljust(4, b"\0")
        return float(struct.unpack("<f", data)[0])
