"""Simulated ground station: direct calls in unit tests, TCP at a router's port."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.support.waiting import PATIENCE_S

OURS = (1, 197)


def asked(message: Any, system: int = 255, component: int = 190) -> Any:
    """A message as it arrives from somebody."""
    [whole] = mavlink.MAVLink(None).parse_buffer(
        bytearray(message.pack(mavlink.MAVLink(None, system, component)))
    )
    return whole


class GroundStation:
    """A client of the router, which speaks as (255, 190) and hears all that is sent.

    with GroundStation(port) as ground:
        assert ground.command(31010, 1.0) == [mavlink.MAV_RESULT_ACCEPTED]
    """

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), PATIENCE_S)
        self._codec = mavlink.MAVLink(None, 255, 190)
        self._codec.robust_parsing = True
        self._pending: list[Any] = []

    def __enter__(self) -> GroundStation:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self._socket.close()

    def send(self, message: Any) -> None:
        """Say something."""
        self._socket.sendall(message.pack(self._codec))
        self._codec.seq = (self._codec.seq + 1) % 256

    def heard(self, kind: str, such: Callable[[Any], bool] = lambda _: True) -> Any:
        """The next message of a kind of our component; AssertionError without one."""
        until_s = time.monotonic() + PATIENCE_S
        while (left_s := until_s - time.monotonic()) > 0:
            for message in self._read(left_s):
                source = message.get_srcSystem(), message.get_srcComponent()
                if source == OURS and message.get_type() == kind and such(message):
                    return message
        raise AssertionError(f"no {kind} in {PATIENCE_S:g} s")

    def command(self, number: int, *values: float) -> list[int]:
        """Give a COMMAND_LONG; the MAV_RESULTs that it is answered with, each but once in a row."""
        parameters = [*values, *[0.0] * (7 - len(values))]
        self.send(mavlink.MAVLink_command_long_message(*OURS, number, 0, *parameters))
        results: list[int] = []
        while not results or results[-1] == mavlink.MAV_RESULT_IN_PROGRESS:
            answer = self.heard("COMMAND_ACK", lambda ack: ack.command == number)
            if results[-1:] != [answer.result]:
                results.append(answer.result)
        return results

    def parameters(self) -> dict[str, float]:
        """All of them, by name."""
        self.send(mavlink.MAVLink_param_request_list_message(*OURS))
        found: dict[str, float] = {}
        n = 1
        while len(found) < n:
            value = self.heard("PARAM_VALUE")
            found[value.param_id], n = value.param_value, value.param_count
        return found

    def set(self, name: str, value: float) -> float:
        """Set a parameter; what it is then said to be."""
        kind = mavlink.MAV_PARAM_TYPE_REAL32
        self.send(mavlink.MAVLink_param_set_message(*OURS, name.encode(), value, kind))
        said = self.heard("PARAM_VALUE", lambda got: got.param_id == name)
        return float(said.param_value)

    def mission(self) -> list[tuple[float, float, float]]:
        """All of it: latitude, longitude in degrees, and height in metres."""
        self.send(mavlink.MAVLink_mission_request_list_message(*OURS))
        items = []
        for seq in range(self.heard("MISSION_COUNT").count):
            self.send(mavlink.MAVLink_mission_request_int_message(*OURS, seq))
            items.append(self.heard("MISSION_ITEM_INT"))
            assert items[-1].seq == seq
        self.send(mavlink.MAVLink_mission_ack_message(*OURS, mavlink.MAV_MISSION_ACCEPTED))
        return [(item.x * 1e-7, item.y * 1e-7, item.z) for item in items]

    def _read(self, timeout_s: float) -> list[Any]:
        if not self._pending:
            self._socket.settimeout(timeout_s)
            try:
                data = self._socket.recv(1 << 16)
            except TimeoutError:
                return []
            assert data, "the router has hung up"
            self._pending = self._codec.parse_buffer(bytearray(data)) or []
        return [self._pending.pop(0)] if self._pending else []
