"""Simulated autopilot that speaks real MAVLink over a real wire, in a thread of its own.

    with FakeAutopilot("px4", "udpout:127.0.0.1:14550", circle()) as autopilot:
        autopilot.wait_for("ODOMETRY", 10)

`firmware` is "ardupilot" or "px4". The URL is the autopilot's side; `autopilot.url` is what the
daemon then configures:

    udpin:HOST:PORT    speaks once it has heard something; port 0 takes a free one
    udpout:HOST:PORT   speaks at once to that port
    tcpin:HOST:PORT    as ArduPilot's simulator on 5760
    pty:LINK[:BAUD]    a serial port at the path LINK; with BAUD rubbish until that speed is set

What it measures comes from a `Flight` (fake_flight.py): `hover()`, `circle()`, `MadeUpFlight(pose)`
or `RecordedFlight(path)`. It stays at the flight's beginning until `fly`, which begins the flight
and arms; at its end it disarms and stays there. Where pictures of the same flight are played from a
known time, `fly(unix_ns=…, at_monotonic_ns=…)` keeps both together.

    clock          boot_s, drift_ppm (below zero: slow), set when made; boot_ns(monotonic_ns)
    latency        latency_ms and jitter_ms each way, loss: the share of packets lost each way
    rates_hz       by name of message; SET_MESSAGE_INTERVAL changes it, so may a test
    max_rate_hz    of any message, whatever is asked
    lacks          names of messages that this firmware has not
    parameters     a Parameters (fake_parameters.py): parameters["EKF2_EV_CTRL"]
    gps            False: no fix; local position then needs an origin and follows the vision given,
                   before that there is its own height alone, as each firmware tells it
    armed, mode, n_boots
    knows_do_set_origin, answers_timesync, asks_timesync_hz

    fly, arm, disarm, reboot(silent_s)                    things that happen
    silent = True                  component 1 says nothing, though the wire is there
    unplug(), plug()               the wire itself
    say(text, severity)            STATUSTEXT
    send(message, system, component), send_bytes(data)    anything, from anyone
    last_packets                   what was sent last, to be replayed

What it got is in `received` (Received: monotonic_ns, boot_ns, system, component, kind, message);
`of(kind)` filters it, `wait_for(kind, n)` waits for it, `commands(id)` are COMMAND_LONG and _INT.
`timesync` holds its own exchanges with who answered (send_boot_ns, peer_ns, receive_boot_ns) and
`peer_minus_boot_ns()` its estimate, which PX4 uses for the stamps of an ODOMETRY.

By hand:
    python -m tests.support.autopilot.fake_autopilot --flight sample/survey \\
        --url udpout:127.0.0.1:14550
"""

from __future__ import annotations

import argparse
import heapq
import itertools
import math
import random
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.geometry.geodesy import GeoOrigin, origin_of
from tests.support.autopilot.fake_flight import Flight, RecordedFlight, circle, hover
from tests.support.autopilot.fake_parameters import Parameters
from tests.support.autopilot.fake_wire import wire

TICK_S = 0.02
SIGNING_EPOCH_S = 1_420_070_400
"""MAVLink signing counts its time from 2015."""
DO_SET_GLOBAL_ORIGIN = 611
ACCEPTED, DENIED = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_DENIED
UNSUPPORTED = mavlink.MAV_RESULT_UNSUPPORTED
NEEDS_GPS = ("GLOBAL_POSITION_INT", "LOCAL_POSITION_NED")
VISION_LASTS_NS = 1_000_000_000

DEFAULT_RATES_HZ: dict[str, dict[str, float]] = {
    "ardupilot": {"HEARTBEAT": 1, "SYSTEM_TIME": 1},
    "px4": {
        "HEARTBEAT": 1, "SYS_STATUS": 1, "SYSTEM_TIME": 1, "EXTENDED_SYS_STATE": 1, "ATTITUDE": 20,
        "ATTITUDE_QUATERNION": 10, "LOCAL_POSITION_NED": 10, "GLOBAL_POSITION_INT": 5,
        "GPS_RAW_INT": 1, "HOME_POSITION": 0.5, "VFR_HUD": 4,
    },
}  # fmt: skip
OTHERS = (
    "HEARTBEAT", "SYSTEM_TIME", "SYS_STATUS", "EXTENDED_SYS_STATE", "HOME_POSITION",
    "GPS_GLOBAL_ORIGIN", "AUTOPILOT_VERSION",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Received:
    """A message that reached the autopilot, and when."""

    monotonic_ns: int
    boot_ns: int
    system: int
    component: int
    kind: str
    message: Any


class FakeAutopilot:
    """See above. Everything may be called from any thread."""

    def __init__(
        self,
        firmware: str = "ardupilot",
        url: str = "udpin:127.0.0.1:0",
        flight: Flight | None = None,
        *,
        system: int = 1,
        boot_s: float = 60.0,
        drift_ppm: float = 0.0,
        latency_ms: float = 0.0,
        jitter_ms: float = 0.0,
        loss: float = 0.0,
        signing_key: bytes | None = None,
        gps: bool = True,
        lacks: tuple[str, ...] = (),
        max_rate_hz: float = 400.0,
        timesync_hz: float | None = None,
        seed: int = 1,
    ) -> None:
        self.firmware, self.system, self.gps = firmware, system, gps
        self.flight = flight or hover()
        self.lacks = set(lacks)
        self.drift_ppm, self.max_rate_hz = drift_ppm, max_rate_hz
        self.latency_ms, self.jitter_ms, self.loss = latency_ms, jitter_ms, loss
        self.asks_timesync_hz = (
            timesync_hz if timesync_hz is not None else {"px4": 10.0}.get(firmware, 0.1)
        )
        self.answers_timesync = self.knows_do_set_origin = True
        self.parameters = Parameters(firmware)
        self.armed, self.silent, self.n_boots = False, False, 1
        self.mode = 4 if firmware == "ardupilot" else 3 << 16
        self.origin: GeoOrigin | None = self.flight.origin if gps else None
        self.rates_hz: dict[str, float] = dict(DEFAULT_RATES_HZ[firmware])
        self.received: list[Received] = []
        self.n_bad = 0
        """Packets that came damaged, unsigned or wrongly signed."""
        self.timesync: list[tuple[int, int, int]] = []
        self.last_packets: deque[bytes] = deque(maxlen=200)
        self._wire = wire(url)
        self.url = self._wire.url
        self._random = random.Random(seed)
        self._codec = self._new_codec(signing_key)
        self._signing_key = signing_key
        self._begun_ns = time.monotonic_ns()
        self._boot_at_begin_ns = round(boot_s * 1e9)
        self._fly_ns: int | None = None
        self._arms_itself = False
        self._vision: Received | None = None
        self._due_ns: dict[str, int] = {}
        self._last_stamp_s: dict[str, float] = {}
        self._spoken_to = False
        self._agenda: list[tuple[int, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._latest_out_ns = self._latest_in_ns = 0
        self._text_id = itertools.count(1)
        self._lock = threading.RLock()
        self._came = threading.Condition(self._lock)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._live, name="fake autopilot", daemon=True)
        self.fault: BaseException | None = None
        """What ended its thread, if something did; `stop` raises it."""

    # -- life ------------------------------------------------------------------------------------

    def __enter__(self) -> FakeAutopilot:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self.stop()

    def start(self) -> None:
        self._wire.plug()
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join()
        self._wire.unplug()
        if self.fault is not None:
            raise self.fault

    def boot_ns(self, monotonic_ns: int | None = None) -> int:
        """Its own clock at a time of the host's monotonic one, or now."""
        now_ns = time.monotonic_ns() if monotonic_ns is None else monotonic_ns
        passed_ns = now_ns - self._begun_ns
        return self._boot_at_begin_ns + passed_ns + round(passed_ns * self.drift_ppm * 1e-6)

    def monotonic_ns(self, boot_ns: int) -> int:
        """The inverse, since the last boot."""
        passed_ns = (boot_ns - self._boot_at_begin_ns) / (1 + self.drift_ppm * 1e-6)
        return self._begun_ns + round(passed_ns)

    # -- what happens to it ----------------------------------------------------------------------

    def fly(
        self, unix_ns: int | None = None, at_monotonic_ns: int | None = None, arm: bool = True
    ) -> None:
        """Begin the flight, at its recorded time `unix_ns` or its beginning; now or at a time."""
        with self._lock:
            at_ns = time.monotonic_ns() if at_monotonic_ns is None else at_monotonic_ns
            into_ns = 0 if unix_ns is None else unix_ns - self.flight.begin_unix_ns
            self._fly_ns, self._arms_itself = at_ns - into_ns, arm
            if arm:
                self.arm()

    @property
    def flight_s(self) -> float:
        """Where in the flight it is."""
        return self._flight_s(time.monotonic_ns())

    def arm(self, armed: bool = True) -> None:
        with self._lock:
            changed, self.armed = armed is not self.armed, armed
            if changed:
                self.say("Arming motors" if armed else "Disarming motors", 6)
                self._due_ns["HEARTBEAT"] = 0  # said at once

    def disarm(self) -> None:
        self.arm(False)

    def reboot(self, silent_s: float = 0.3, boot_s: float = 0.5) -> None:
        """Begin anew: clock at `boot_s` after `silent_s` of silence, rates forgotten, disarmed."""
        with self._lock:
            now_ns = time.monotonic_ns()
            self._begun_ns = now_ns + round(silent_s * 1e9)
            self._boot_at_begin_ns = round(boot_s * 1e9)
            self.armed, self._vision = False, None
            self.origin = self.flight.origin if self.gps else None
            self.rates_hz = dict(DEFAULT_RATES_HZ[self.firmware])
            self._due_ns.clear()
            self._last_stamp_s.clear()
            self._agenda.clear()
            self.timesync.clear()
            self.n_boots += 1
            self._at(self._begun_ns, lambda: self.say("Calibrating barometer", 6))

    def unplug(self) -> None:
        with self._lock:
            self._wire.unplug()

    def plug(self) -> None:
        with self._lock:
            self._wire.plug()

    def say(self, text: str, severity: int = 6) -> None:
        """STATUSTEXT, in chunks where it is long."""
        data = text.encode()
        chunks = [data[at : at + 50] for at in range(0, len(data), 50)] or [b""]
        number = next(self._text_id) if len(chunks) > 1 else 0
        for place, chunk in enumerate(chunks):
            self.send(mavlink.MAVLink_statustext_message(severity, chunk, number, place))

    def send(self, message: Any, system: int | None = None, component: int = 1) -> None:
        """Send any message, as anyone."""
        with self._lock:
            codec = self._codec
            codec.srcSystem = self.system if system is None else system
            codec.srcComponent = component
            packet = bytes(message.pack(codec))
            codec.seq = (codec.seq + 1) % 256
            self.last_packets.append(packet)
            self.send_bytes(packet)

    def send_bytes(self, data: bytes) -> None:
        """Send anything at all, subject to loss and latency."""
        with self._lock:
            if self._lost():
                return
            due_ns = max(self._latest_out_ns, time.monotonic_ns() + self._delay_ns())
            self._latest_out_ns = due_ns
            if self.latency_ms or self.jitter_ms:
                self._at(due_ns, lambda: self._wire.send(data))
            else:
                self._wire.send(data)

    # -- what it got -----------------------------------------------------------------------------

    def of(self, *kinds: str) -> list[Received]:
        """What came of these kinds, in order."""
        with self._lock:
            return [each for each in self.received if each.kind in kinds]

    def commands(self, command: int) -> list[Received]:
        """COMMAND_LONG and COMMAND_INT that asked for this."""
        found = self.of("COMMAND_LONG", "COMMAND_INT")
        return [each for each in found if each.message.command == command]

    def texts(self) -> list[str]:
        """STATUSTEXT that came, put together again."""
        out: list[str] = []
        for each in self.of("STATUSTEXT"):
            if each.message.chunk_seq and out:
                out[-1] += each.message.text
            else:
                out.append(each.message.text)
        return out

    def clear(self) -> None:
        """Forget what came so far."""
        with self._lock:
            self.received.clear()

    def wait_for(
        self, kind: str, n: int = 1, timeout_s: float = 5.0,
        such: Callable[[Received], bool] = lambda _: True,
    ) -> list[Received]:  # fmt: skip
        """The first n of a kind; AssertionError if they do not come in time."""
        until_s = time.monotonic() + timeout_s
        with self._came:
            while True:
                found = [each for each in self.received if each.kind == kind and such(each)]
                if len(found) >= n:
                    return found[:n]
                left_s = until_s - time.monotonic()
                if left_s <= 0 or self.fault is not None:
                    raise AssertionError(f"{len(found)} of {n} {kind} in {timeout_s} s", self.fault)
                self._came.wait(left_s)

    def peer_minus_boot_ns(self) -> int | None:
        """The peer's clock minus its own, by the newest exchanges of shortest round trip."""
        with self._lock:
            recent = self.timesync[-20:]
        if not recent:
            return None
        send, peer, receive = min(recent, key=lambda each: each[2] - each[0])
        return peer - (send + receive) // 2

    # -- its thread ------------------------------------------------------------------------------

    def _live(self) -> None:
        try:
            while not self._stop.is_set():
                with self._lock:
                    now_ns = time.monotonic_ns()
                    self._take(now_ns)
                    self._do_due(now_ns)
                    wake_ns = self._send_due(now_ns)
                self._wire.wait(min(TICK_S, (wake_ns - time.monotonic_ns()) * 1e-9))
        except BaseException as error:
            self.fault = error

    def _at(self, due_ns: int, what: Callable[[], None]) -> None:
        heapq.heappush(self._agenda, (due_ns, next(self._order), what))

    def _do_due(self, now_ns: int) -> None:
        while self._agenda and self._agenda[0][0] <= now_ns:
            heapq.heappop(self._agenda)[2]()

    def _take(self, now_ns: int) -> None:
        for data in self._wire.receive():
            if not self._spoken_to:
                self._spoken_to = True
                self._due_ns["HEARTBEAT"] = 0  # on UDP nobody has heard the one before
            before = self._codec.total_receive_errors
            try:
                messages = self._codec.parse_buffer(bytearray(data)) or []
            except mavlink.MAVError:
                messages = []
            self.n_bad += self._codec.total_receive_errors - before
            for message in messages:
                if message.get_type() == "BAD_DATA":
                    self.n_bad += 1
                    continue
                if self._lost():
                    continue
                due_ns = max(self._latest_in_ns, now_ns + self._delay_ns())
                self._latest_in_ns = due_ns
                if due_ns <= now_ns:
                    self._got(message)
                else:
                    self._at(due_ns, lambda message=message: self._got(message))  # type: ignore[misc]

    def _send_due(self, now_ns: int) -> int:
        """Send what is due; the time at which the next thing is."""
        wake_ns = self._agenda[0][0] if self._agenda else now_ns + round(TICK_S * 1e9)
        if now_ns < self._begun_ns or self.silent:
            return wake_ns
        if self._arms_itself and self._flight_s(now_ns) >= self.flight.duration_s:
            self._arms_itself = False
            self.disarm()
        if self.asks_timesync_hz and self._is_due("TIMESYNC", self.asks_timesync_hz, now_ns):
            # read once more: what was packed meanwhile took its time
            self.send(mavlink.MAVLink_timesync_message(0, self.boot_ns()))
        if self.asks_timesync_hz:
            wake_ns = min(wake_ns, self._due_ns["TIMESYNC"])
        for kind, rate_hz in self.rates_hz.items():
            if rate_hz <= 0 or kind in self.lacks:
                continue
            if self._is_due(kind, min(rate_hz, self.max_rate_hz), now_ns):
                message = self._message(kind, now_ns)
                if message is not None:
                    self.send(message)
            wake_ns = min(wake_ns, self._due_ns[kind])
        return wake_ns

    def _is_due(self, kind: str, rate_hz: float, now_ns: int) -> bool:
        due_ns = self._due_ns.get(kind, 0)
        if now_ns < due_ns:
            return False
        period_ns = round(1e9 / rate_hz)
        # a stream that fell behind does not make up for it
        in_step = now_ns - due_ns < period_ns
        self._due_ns[kind] = (due_ns if in_step else now_ns) + period_ns
        return True

    def _flight_s(self, monotonic_ns: int) -> float:
        if self._fly_ns is None:
            return 0.0
        return min(max(0.0, (monotonic_ns - self._fly_ns) * 1e-9), self.flight.duration_s)

    # -- what it says ----------------------------------------------------------------------------

    def _message(self, kind: str, now_ns: int) -> Any | None:
        make = getattr(self, f"_{kind.lower()}", None)
        if make is not None:
            return make(now_ns)
        flight_s = self._flight_s(now_ns)
        measured = self.flight.message(kind, flight_s)
        if measured is None:
            return None
        message, at_s = measured
        if kind == "GPS_RAW_INT" and not self.gps:
            message = mavlink.MAVLink_gps_raw_int_message(
                0, 1, 0, 0, 0, 65535, 65535, 65535, 65535, 0, 0, 0, 0, 0, 0, 0
            )
        elif kind in NEEDS_GPS and not self.gps:
            message = self._by_vision(kind, now_ns) or self._by_itself(kind, flight_s)
            if message is None:
                return None
            at_s = flight_s
        stamp_ns = now_ns
        if 0 < flight_s < self.flight.duration_s:
            if self._last_stamp_s.get(kind) == at_s or at_s > flight_s:
                return None  # nothing new was measured, or nothing yet
            self._last_stamp_s[kind] = at_s
            stamp_ns = now_ns - round((flight_s - at_s) * 1e9)
        boot_ns = max(0, self.boot_ns(stamp_ns))
        if hasattr(message, "time_boot_ms"):
            message.time_boot_ms = boot_ns // 10**6
        elif hasattr(message, "time_usec"):
            message.time_usec = boot_ns // 1000
        return message

    def _by_itself(self, kind: str, flight_s: float) -> Any | None:
        """What it says that does not know where it is, but how high.

        PX4 tells its local height; ArduCopter withholds its local position, and its place on Earth
        stands still, but for the height above home.
        """
        tells = "LOCAL_POSITION_NED" if self.firmware == "px4" else "GLOBAL_POSITION_INT"
        measured = self.flight.message("LOCAL_POSITION_NED", flight_s)
        if kind != tells or measured is None:
            return None
        down_m, speed_m_s = self._down(measured[0])
        if kind == "LOCAL_POSITION_NED":
            return mavlink.MAVLink_local_position_ned_message(0, 0, 0, down_m, 0, 0, speed_m_s)
        return mavlink.MAVLink_global_position_int_message(
            0, 0, 0, 0, round(-1e3 * down_m), 0, 0, round(1e2 * speed_m_s), 65535
        )

    def _down(self, true: Any) -> tuple[float, float]:
        """Its own height in its local frame, and how fast that changes; m, m/s, down."""
        return true.z, true.vz

    def _by_vision(self, kind: str, now_ns: int) -> Any | None:
        """Where it takes itself to be without GPS: where it was told that it is."""
        seen = self._vision
        if seen is None or now_ns - seen.monotonic_ns > VISION_LASTS_NS:
            return None
        m = seen.message
        if kind == "LOCAL_POSITION_NED":
            if self.firmware == "ardupilot" and self.origin is None:
                return None
            return mavlink.MAVLink_local_position_ned_message(0, m.x, m.y, m.z, 0, 0, 0)
        if self.origin is None:
            return None
        o = self.origin
        there = origin_of(o.latitude_deg, o.longitude_deg, o.altitude_m, [-m.x, -m.y, -m.z])  # type: ignore[arg-type]
        place = (there.latitude_deg * 1e7, there.longitude_deg * 1e7, there.altitude_m * 1e3)
        return mavlink.MAVLink_global_position_int_message(
            0, *map(round, place), round(-1e3 * m.z), 0, 0, 0, 65535
        )

    def _heartbeat(self, _now_ns: int) -> Any:
        flags = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        flags |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0
        autopilot = (
            mavlink.MAV_AUTOPILOT_PX4 if self.firmware == "px4"
            else mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
        )  # fmt: skip
        state = mavlink.MAV_STATE_ACTIVE if self.armed else mavlink.MAV_STATE_STANDBY
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR, autopilot, flags, self.mode, state, 3
        )

    def _system_time(self, now_ns: int) -> Any:
        unix_us = time.time_ns() // 1000 if self.gps else 0
        return mavlink.MAVLink_system_time_message(unix_us, max(0, self.boot_ns(now_ns)) // 10**6)

    def _sys_status(self, _now_ns: int) -> Any:
        return mavlink.MAVLink_sys_status_message(0, 0, 0, 120, 16200, -1, 99, 0, 0, 0, 0, 0, 0)

    def _extended_sys_state(self, _now_ns: int) -> Any:
        return mavlink.MAVLink_extended_sys_state_message(0, 2 if self.armed else 1)

    def _gps_global_origin(self, now_ns: int) -> Any | None:
        return self._place_message(mavlink.MAVLink_gps_global_origin_message, now_ns)

    def _home_position(self, now_ns: int) -> Any | None:
        return self._place_message(mavlink.MAVLink_home_position_message, now_ns)

    def _place_message(self, make: Any, now_ns: int) -> Any | None:
        if self.origin is None:
            return None
        place = (
            round(self.origin.latitude_deg * 1e7), round(self.origin.longitude_deg * 1e7),
            round(self.origin.altitude_m * 1e3),
        )  # fmt: skip
        stamp_us = max(0, self.boot_ns(now_ns)) // 1000
        if make is mavlink.MAVLink_gps_global_origin_message:
            return make(*place, stamp_us)
        return make(*place, 0, 0, 0, [1.0, 0, 0, 0], 0, 0, 0, stamp_us)

    def _autopilot_version(self, _now_ns: int) -> Any:
        version = (1 << 24 | 15 << 16) if self.firmware == "px4" else (4 << 24 | 6 << 16)
        return mavlink.MAVLink_autopilot_version_message(
            0x2000, version, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0
        )

    # -- what it does with what it hears ---------------------------------------------------------

    def _got(self, message: Any) -> None:
        now_ns = time.monotonic_ns()
        if now_ns < self._begun_ns:
            return  # it is booting
        kind = message.get_type()
        got = Received(
            now_ns, self.boot_ns(now_ns), message.get_srcSystem(), message.get_srcComponent(), kind,
            message,
        )  # fmt: skip
        self.received.append(got)
        self._came.notify_all()
        target = getattr(message, "target_system", 0), getattr(message, "target_component", 0)
        if self.silent or target[0] not in (0, self.system) or target[1] not in (0, 1):
            return
        answer = getattr(self, f"_on_{kind.lower()}", None)
        if answer is not None:
            answer(got)

    def _on_timesync(self, got: Received) -> None:
        tc1, ts1 = got.message.tc1, got.message.ts1
        if tc1 == 0:
            if self.answers_timesync:
                self.send(mavlink.MAVLink_timesync_message(self.boot_ns(), ts1))
        elif 0 <= got.boot_ns - ts1 < 10**9:
            self.timesync.append((ts1, tc1, got.boot_ns))

    def _on_odometry(self, got: Received) -> None:
        self._vision = got

    _on_vision_position_estimate = _on_odometry

    def _on_set_gps_global_origin(self, got: Received) -> None:
        m = got.message
        self._take_origin(m.latitude * 1e-7, m.longitude * 1e-7, m.altitude * 1e-3)

    def _take_origin(self, latitude_deg: float, longitude_deg: float, altitude_m: float) -> None:
        if self.origin is None or self.firmware == "px4":  # ArduPilot takes the first for good
            self.origin = GeoOrigin(latitude_deg, longitude_deg, altitude_m)
        message = self._gps_global_origin(time.monotonic_ns())
        self.send(message)

    def _on_command_long(self, got: Received) -> None:
        m = got.message
        self._command(got, [m.param1, m.param2, m.param3, m.param4, m.param5, m.param6, m.param7])

    def _on_command_int(self, got: Received) -> None:
        m = got.message
        self._command(got, [m.param1, m.param2, m.param3, m.param4, m.x * 1e-7, m.y * 1e-7, m.z])

    def _command(self, got: Received, values: list[float]) -> None:
        command = got.message.command
        result = UNSUPPORTED
        after: Callable[[], None] | None = None
        if command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            result = self._set_interval(int(values[0]), values[1])
        elif command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            kind = self._kind(int(values[0]))
            message = self._message(kind, time.monotonic_ns()) if kind else None
            result = DENIED if message is None else ACCEPTED
            if message is not None:
                after = lambda: self.send(message)  # noqa: E731
        elif command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
            result = ACCEPTED
            self.arm(values[0] == 1)
        elif command == mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN and values[0] == 1:
            result = DENIED if self.armed else ACCEPTED
            after = None if self.armed else self.reboot
        elif command == mavlink.MAV_CMD_PREFLIGHT_STORAGE and values[0] == 1:
            result = ACCEPTED if self.firmware == "px4" and not self.armed else UNSUPPORTED
            if result == ACCEPTED:
                self.parameters.store()
        elif command == mavlink.MAV_CMD_SET_EKF_SOURCE_SET and self.firmware == "ardupilot":
            result = ACCEPTED
        elif command == DO_SET_GLOBAL_ORIGIN and self.knows_do_set_origin:
            # its latitude and longitude have their digits in a COMMAND_INT only
            result = ACCEPTED if got.kind == "COMMAND_INT" else DENIED
            if result == ACCEPTED:
                self._take_origin(*values[4:])
        self.send(
            mavlink.MAVLink_command_ack_message(command, result, 0, 0, got.system, got.component)
        )
        if after is not None:
            after()

    def _kind(self, number: int) -> str | None:
        """The name of a message that this firmware has."""
        known = mavlink.mavlink_map.get(number)
        if known is None or known.msgname in self.lacks:
            return None
        name = str(known.msgname)
        return name if name in self.flight.kinds or name in OTHERS else None

    def _set_interval(self, number: int, interval_us: float) -> int:
        kind = self._kind(number)
        if kind is None:
            return int(DENIED)
        if interval_us == 0:
            rate_hz = DEFAULT_RATES_HZ[self.firmware].get(kind, 0.0)
        else:
            rate_hz = 0.0 if interval_us < 0 else 1e6 / interval_us
        self.rates_hz[kind] = rate_hz
        self._due_ns.pop(kind, None)
        return int(ACCEPTED)

    def _on_param_request_list(self, _got: Received) -> None:
        now_ns = time.monotonic_ns()
        for place, name in enumerate(self.parameters.listed()):
            self._at(now_ns + place * 2_000_000, lambda name=name: self._send_parameter(name))  # type: ignore[misc]

    def _on_param_request_read(self, got: Received) -> None:
        names = self.parameters.listed()
        index = got.message.param_index
        name = got.message.param_id if index < 0 else (names[index] if index < len(names) else "")
        self._send_parameter(name)

    def _on_param_set(self, got: Received) -> None:
        name = got.message.param_id
        if name in self.parameters:
            self.parameters.set(name, got.message.param_value, got.message.param_type)
            self._send_parameter(name)

    def _send_parameter(self, name: str) -> None:
        if name in self.parameters and not self.silent:
            self.send(self.parameters.value_message(name))

    # -- its wire --------------------------------------------------------------------------------

    def _new_codec(self, key: bytes | None) -> Any:
        codec = mavlink.MAVLink(None)
        codec.robust_parsing = True
        if key is not None:
            codec.signing.secret_key = key
            codec.signing.sign_outgoing = True
            codec.signing.timestamp = round((time.time() - SIGNING_EPOCH_S) * 1e5)
        return codec

    def _lost(self) -> bool:
        return self.loss > 0 and self._random.random() < self.loss

    def _delay_ns(self) -> int:
        if not (self.latency_ms or self.jitter_ms):
            return 0
        jitter_ms = self._random.expovariate(1 / self.jitter_ms) if self.jitter_ms else 0.0
        return round(1e6 * (self.latency_ms + jitter_ms))


def main() -> None:
    parser = argparse.ArgumentParser(description="A pretended autopilot, to try a daemon by hand.")
    parser.add_argument("--url", default="udpout:127.0.0.1:14550")
    parser.add_argument("--firmware", choices=("ardupilot", "px4"), default="ardupilot")
    parser.add_argument("--flight", type=Path, help="a .tlog or its folder; else a circle")
    parser.add_argument("--system", type=int, default=1)
    parser.add_argument("--drift-ppm", type=float, default=0.0)
    parser.add_argument("--latency-ms", type=float, default=0.0)
    parser.add_argument("--jitter-ms", type=float, default=0.0)
    parser.add_argument("--loss", type=float, default=0.0)
    parser.add_argument("--no-gps", action="store_true")
    parser.add_argument("--signing-key", type=Path, help="file of 64 hexadecimal digits")
    parser.add_argument("--fly-after", type=float, default=3.0, help="seconds until it flies")
    options = parser.parse_args()
    key = bytes.fromhex(options.signing_key.read_text()) if options.signing_key else None
    autopilot = FakeAutopilot(
        options.firmware, options.url,
        RecordedFlight(options.flight) if options.flight else circle(),
        system=options.system, drift_ppm=options.drift_ppm, latency_ms=options.latency_ms,
        jitter_ms=options.jitter_ms, loss=options.loss, gps=not options.no_gps, signing_key=key,
    )  # fmt: skip
    print(f"the daemon's side: --set link.url={autopilot.url}", flush=True)
    with autopilot:
        try:
            time.sleep(options.fly_after)
            autopilot.fly()
            length = autopilot.flight.duration_s
            print(f"flying{'' if math.isinf(length) else f' for {length:.0f} s'}", flush=True)
            seen = 0
            while True:
                time.sleep(1)
                got = autopilot.received[seen:]
                seen += len(got)
                counts = dict(Counter(each.kind for each in got))
                armed = "armed" if autopilot.armed else "disarmed"
                print(f"{autopilot.flight_s:7.1f} s, {armed}, got {counts}", flush=True)
        except KeyboardInterrupt:
            pass


if __name__ == "__main__":
    main()
