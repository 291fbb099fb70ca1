"""The ground station of a trial: hears everything, knows the truth, gives commands, holds sticks.

    with Ground(port, home) as ground:
        ground.true[-1], ground.latest["LOCAL_POSITION_NED"], ground.texts

Times are seconds since the epoch. Truth is the simulator's own state about `home`, local NED.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Array
from tests.firmware.true_state import State, TrueState

RATES_HZ = {
    "SIM_STATE": 100.0, "HIL_STATE_QUATERNION": 100.0, "LOCAL_POSITION_NED": 20.0,
    "ATTITUDE": 20.0, "EKF_STATUS_REPORT": 10.0, "ESTIMATOR_STATUS": 5.0, "SYS_STATUS": 4.0,
    "EXTENDED_SYS_STATE": 4.0, "GLOBAL_POSITION_INT": 5.0,
}  # fmt: skip
STICKS_EVERY_S = 0.05
AUTOPILOT, COMPANION = (1, 1), (1, 197)
STAMP_BYTES, MAVLINK_2 = 8, 0xFD
CENTRED, THROTTLE_LOW = (0.0, 0.0, 0.5, 0.0), (0.0, 0.0, 0.0, 0.0)
"""Roll, pitch and yaw from -1 to 1, throttle from 0 to 1: in the air, and to be armed."""


def messages_heard(path: Path, kind: str) -> Iterator[tuple[float, Any]]:
    """Messages of a kind in a tlog with their times; the companion's are `COMPANION/` and kind."""
    source = COMPANION if kind.startswith("COMPANION/") else AUTOPILOT
    number = getattr(mavlink, f"MAVLINK_MSG_ID_{kind.removeprefix('COMPANION/')}")
    codec = mavlink.MAVLink(None)
    codec.robust_parsing = True
    data = path.read_bytes()
    at = STAMP_BYTES
    while at + 12 <= len(data):
        is_long = data[at] == MAVLINK_2
        length = data[at + 1] + (12 + 13 * (data[at + 2] & 1) if is_long else 8)
        if is_long and (data[at + 5], data[at + 6], data[at + 7]) == (*source, number & 255):
            for message in codec.parse_buffer(bytearray(data[at : at + length])) or []:
                if message.get_msgId() == number:
                    yield struct.unpack_from(">Q", data, at - STAMP_BYTES)[0] * 1e-6, message
        at += length + STAMP_BYTES


class Ground:
    """See above."""

    def __init__(self, port: int, home: GeoOrigin, log: Path) -> None:
        self._state = TrueState(origin=home)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        self._socket.bind(("127.0.0.1", port))
        self._socket.settimeout(0.2)
        self._peer: tuple[str, int] | None = None
        self._codec = mavlink.MAVLink(None, 255, 190)
        self._lock, self._came = threading.Lock(), threading.Condition()
        self._log: IO[bytes] = log.open("wb")
        self._on = True
        self.latest: dict[str, Any] = {}
        """By kind, of the autopilot; of the companion's, by `COMPANION/` and kind."""
        self.came_s: dict[str, float] = {}
        self.texts: list[tuple[float, str]] = []
        self.true: list[State] = []
        self.believed: list[tuple[float, float, float, float]] = []
        """LOCAL_POSITION_NED: time, north, east, down."""
        self.modes: list[tuple[float, str]] = []
        self.named: Callable[[int], str] = str
        """The name of a mode by HEARTBEAT.custom_mode."""
        self.sticks: Callable[[], tuple[float, float, float, float]] | None = None
        """Held down at 20 Hz, see `CENTRED`; None: no remote control."""
        self.hold_sticks: Callable[[tuple[float, float, float, float]], Any] | None = None
        """The message that this firmware takes sticks by."""
        self.setpoint: Callable[[], Any] | None = None
        """A message that is repeated with the sticks, for modes that want a stream."""
        self._threads = [
            threading.Thread(target=run, daemon=True, name=f"ground {run.__name__}")
            for run in (self._hear, self._speak)
        ]

    def __enter__(self) -> Ground:
        for each in self._threads:
            each.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self._on = False
        for each in self._threads:
            each.join()
        self._socket.close()
        self._log.close()

    # -- what is known ---------------------------------------------------------------------------

    @property
    def place_m(self) -> Array:
        """Where the vehicle truly is (3,)."""
        return self.true[-1].place_m

    @property
    def believed_m(self) -> Array:
        """Where the autopilot believes it to be (3,)."""
        return np.array(self.believed[-1][1:])

    @property
    def armed(self) -> bool:
        """As the autopilot says."""
        heard = self.latest.get("HEARTBEAT")
        return bool(heard and heard.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)

    @property
    def mode(self) -> str:
        """As the autopilot says."""
        return self.modes[-1][1] if self.modes else ""

    def texts_since(self, t_s: float) -> list[str]:
        """What a pilot reads, of all components of the vehicle."""
        return [text for when_s, text in self.texts if when_s >= t_s]

    def window(self, from_s: float, to_s: float) -> Array:
        """True places (N, 3) between two times."""
        found = [each.place_m for each in self.true if from_s <= each.t_s <= to_s]
        return np.array(found).reshape(-1, 3)

    def until(self, such: Callable[[], Any], timeout_s: float) -> bool:
        """Wait for something that messages bring; whether it came."""
        end_s = time.monotonic() + timeout_s
        with self._came:
            while not such():
                left_s = end_s - time.monotonic()
                if left_s <= 0:
                    return False
                self._came.wait(min(left_s, 0.2))
        return True

    # -- what is said ----------------------------------------------------------------------------

    def send(self, message: Any) -> None:
        """Say something, once somebody has been heard."""
        if self._peer is None:
            return
        with self._lock:
            data = message.pack(self._codec)
            self._codec.seq = (self._codec.seq + 1) % 256
            self._socket.sendto(data, self._peer)

    def command(self, number: int, *values: float, timeout_s: float = 3.0) -> int | None:
        """COMMAND_LONG to the autopilot; its MAV_RESULT, None without an answer."""
        began_s = time.time()
        parameters = [*values, *[0.0] * (7 - len(values))]
        self.send(mavlink.MAVLink_command_long_message(*AUTOPILOT, number, 0, *parameters))

        def is_answered() -> bool:
            answer = self.latest.get("COMMAND_ACK")
            return bool(
                answer and answer.command == number and self.came_s["COMMAND_ACK"] >= began_s
            )

        if not self.until(is_answered, timeout_s):
            return None
        return int(self.latest["COMMAND_ACK"].result)

    def ask_for_messages(self) -> None:
        """What a trial goes by, at its rates; not all firmwares have all."""
        for name, rate_hz in RATES_HZ.items():
            number = getattr(mavlink, f"MAVLINK_MSG_ID_{name}")
            self.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, number, 1e6 / rate_hz)

    # -- within ----------------------------------------------------------------------------------

    def _hear(self) -> None:
        codec = mavlink.MAVLink(None)
        codec.robust_parsing = True
        while self._on:
            try:
                data, self._peer = self._socket.recvfrom(1 << 16)
            except TimeoutError:
                continue
            now_s = time.time()
            messages = codec.parse_buffer(bytearray(data)) or []
            with self._came:
                for message in messages:
                    self._take(message, now_s)
                self._came.notify_all()

    def _take(self, message: Any, now_s: float) -> None:
        kind = message.get_type()
        if kind == "BAD_DATA":
            return
        self._log.write(struct.pack(">Q", round(now_s * 1e6)) + bytes(message.get_msgbuf()))
        source = message.get_srcSystem(), message.get_srcComponent()
        if kind == "STATUSTEXT" and source[0] == AUTOPILOT[0]:
            self.texts.append((now_s, message.text))
        if source != AUTOPILOT:
            if source == COMPANION:
                self.latest[f"COMPANION/{kind}"] = message
                self.came_s[f"COMPANION/{kind}"] = now_s
            return
        self.latest[kind], self.came_s[kind] = message, now_s
        if kind == "HEARTBEAT":
            name = self.named(message.custom_mode)
            if not self.modes or self.modes[-1][1] != name:
                self.modes.append((now_s, name))
        elif kind == "LOCAL_POSITION_NED":
            self.believed.append((now_s, message.x, message.y, message.z))
        elif kind in ("SIM_STATE", "HIL_STATE_QUATERNION"):
            self._state.take(message, now_s)
            if (newest := self._state.newest) is not None:
                self.true.append(newest)

    def _speak(self) -> None:
        beat = mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
        )
        next_s = 0.0
        while self._on:
            now_s = time.monotonic()
            if now_s >= next_s:
                self.send(beat)
                next_s = now_s + 1.0
            if self.sticks is not None and self.hold_sticks is not None:
                self.send(self.hold_sticks(self.sticks()))
            if self.setpoint is not None:
                self.send(self.setpoint())
            time.sleep(STICKS_EVERY_S)
