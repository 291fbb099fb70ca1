"""Messages of a live autopilot as samples on the flight's clock: live counterpart of log readers.

Of several messages for one quantity one type is taken, as from a log: of attitudes the more
frequent, of the others the first available. Stamps that are not of the present boot, or not later
than the one before, are dropped and counted.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.geometry.geodesy import GeoOrigin
from companion.messages import Warned
from companion.telemetry import PositionSample, PositionSource, Telemetry
from companion.timing.link_clock import ClockFilter
from companion.timing.stamp_filter import MAX_BOOT_NS
from drivers.telemetry.gimbal_messages import GIMBAL_IDS, GimbalChoice, gimbal_of, is_stamped
from drivers.telemetry.live_positions import LivePositions
from drivers.telemetry.mavlink_samples import (
    ATTITUDE_IDS,
    IMU_IDS,
    READERS,
    boot_ns,
    samples_of,
    searches,
)
from drivers.telemetry.telemetry_log import GeodeticFix, is_finite

LATE_NS, AHEAD_NS = 2_000_000_000, 100_000_000
"""Delay that is reported; a stamp further in the future than the second is invalid."""
WARN_AGAIN_NS = 10_000_000_000
CHOOSE_NS = 1_000_000_000
"""Interval at which the more frequent of several messages is chosen."""
ABOUT = 1.25
"""Ratio of rates within which messages count as equally frequent."""
MOST_AWAY_M = 1e6

OUT_OF_ORDER, WILD, LATE = "telemetry out of order", "telemetry stamped wildly", "telemetry late"
AHEAD, UNUSABLE = "telemetry from the future", "telemetry that is not usable"


class LiveSamples:
    """Stamps, georeferences and passes on the measurements of the vehicle's autopilot."""

    def __init__(
        self,
        clock: ClockFilter,
        deliver: Callable[[Telemetry], None],
        warn: Callable[[Warned], None],
    ) -> None:
        self._clock, self._deliver, self._warn = clock, deliver, warn
        self.positions = LivePositions()
        self.gps_searches = False
        """True while the autopilot's GPS sees satellites, and has no fix yet."""
        self.less_biases = False
        """True where HIGHRES_IMU is less the biases of the autopilot's EKF (`takes_biases_off`)."""
        self.n_dropped: Counter[str] = Counter()
        """By reason."""
        self._unix_minus_boot_ns: int | None = None
        self._segment = clock.n_segments
        self._stamps: dict[int, int] = {}
        self._latest: dict[str, tuple[int, int]] = {}
        """Newest stamp by quantity, and the time that it was given."""
        self._choices = (_Choice(ATTITUDE_IDS, frequent=True), _Choice(IMU_IDS, frequent=False))
        self._gimbal = GimbalChoice()
        self._wild = ""
        self._warned_ns: dict[str, int] = {}

    def take(self, message: Any, receive_ns: int) -> None:
        """Take any message of the autopilot."""
        kind = message.get_msgId()
        if kind == mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN:
            self._take_origin(message, receive_ns)
            return
        if kind == mavlink.MAVLINK_MSG_ID_GPS_RAW_INT:
            self.gps_searches = searches(message)
        if kind in GIMBAL_IDS:
            self.take_gimbal(message, receive_ns)
            return
        if kind not in READERS and kind != mavlink.MAVLINK_MSG_ID_SYSTEM_TIME:
            return
        try:
            with np.errstate(all="ignore"):  # what comes of infinities is looked at afterwards
                self._take(kind, message, receive_ns)
        except (ArithmeticError, ValueError) as error:  # numbers that make no sense together
            self._drop(UNUSABLE, receive_ns, f"{message.get_type()}: {error}")

    def take_gimbal(self, message: Any, receive_ns: int) -> None:
        """Take a message of GIMBAL_IDS, of the autopilot or of the gimbal itself."""
        if not self._gimbal.takes(message, receive_ns):
            return
        name = message.get_type()
        with np.errstate(all="ignore"):
            sample = gimbal_of(message)
        if sample is None or not is_finite(sample):
            self._drop(UNUSABLE, receive_ns, f"{name}: no attitude")
            return
        boot_ns = message.time_boot_ms * 10**6 if is_stamped(message) else None
        t_ns = receive_ns if boot_ns is None else self._clock.host_ns(boot_ns)
        if t_ns is None:
            self.n_dropped["telemetry before the clock was known"] += 1
            return
        if self._is_in_order(_quantity(sample), t_ns, t_ns, receive_ns, name):
            self._deliver(dataclasses.replace(sample, t_ns=t_ns))

    def _take(self, kind: int, message: Any, receive_ns: int) -> None:
        if kind == mavlink.MAVLINK_MSG_ID_SYSTEM_TIME and message.time_unix_usec:
            self._unix_minus_boot_ns = message.time_unix_usec * 1000 - message.time_boot_ms * 10**6
        remote_ns = boot_ns(message, self._unix_minus_boot_ns)
        if remote_ns is None:
            if samples_of(message, self.less_biases):  # without a receiver GPS has neither
                self.n_dropped["telemetry without boot time"] += 1
            return
        if self._stamps.get(kind) == remote_ns:
            return  # sent again because nothing newer was measured
        self._stamps[kind] = remote_ns
        if not 0 <= remote_ns <= MAX_BOOT_NS or not self._clock.one_way(remote_ns, receive_ns):
            # named when it is clear that no reboot has begun with it
            self._wild = f"{message.get_type()} at {remote_ns * 1e-9:.1f} s"
            self.n_dropped[WILD] += 1
            return
        if self._segment != self._clock.n_segments:
            self._begin()
        if self._wild:
            self._warn_once(WILD, receive_ns, self._wild)
            self._wild = ""
        for sample in samples_of(message, self.less_biases):
            if not is_finite(sample) or not _on_earth(sample):
                self._drop(UNUSABLE, receive_ns, f"{message.get_type()}: impossible values")
            elif all(choice.takes(kind, receive_ns) for choice in self._choices):
                self._pass_on(sample, remote_ns, receive_ns, message.get_type())

    def _pass_on(
        self, content: Telemetry | GeodeticFix, remote_ns: int, receive_ns: int, name: str
    ) -> None:
        t_ns = self._clock.host_ns(remote_ns)
        if t_ns is None:
            self.n_dropped["telemetry before the clock was known"] += 1
            return
        if not self._is_in_order(_quantity(content), remote_ns, t_ns, receive_ns, name):
            return
        if receive_ns - t_ns > LATE_NS:
            self._warn_once(LATE, receive_ns, f"{name} by {(receive_ns - t_ns) * 1e-9:.1f} s")
        sample = self._placed(content, remote_ns)
        if sample is None:
            self.n_dropped["positions without an origin"] += 1
            return
        self._deliver(dataclasses.replace(sample, t_ns=t_ns))

    def _is_in_order(
        self, quantity: str, remote_ns: int, t_ns: int, receive_ns: int, name: str
    ) -> bool:
        """True of a sample that is later than the one before, and not of the future."""
        latest_ns, latest_t_ns = self._latest.get(quantity, (-1, -1))
        if remote_ns <= latest_ns or t_ns <= latest_t_ns:
            self._drop(OUT_OF_ORDER, receive_ns, name)
        elif t_ns > receive_ns + max(AHEAD_NS, 5 * self._clock.sigma_ns):
            self._drop(AHEAD, receive_ns, f"{name} by {(t_ns - receive_ns) * 1e-9:.2f} s")
        else:
            self._latest[quantity] = remote_ns, t_ns
            return True
        return False

    def _placed(self, content: Telemetry | GeodeticFix, remote_ns: int) -> Telemetry | None:
        if isinstance(content, GeodeticFix):
            return self.positions.fix(content, remote_ns)
        if isinstance(content, PositionSample) and content.source is PositionSource.LOCAL:
            return self.positions.local(content, remote_ns)
        return content

    def _take_origin(self, message: Any, receive_ns: int) -> None:
        latitude_deg, longitude_deg = message.latitude * 1e-7, message.longitude * 1e-7
        if not _is_place(latitude_deg, longitude_deg):
            self._drop(UNUSABLE, receive_ns, f"{message.get_type()}: impossible values")
        elif message.latitude or message.longitude:  # both 0 is what is not set
            self.positions.set_origin(
                GeoOrigin(latitude_deg, longitude_deg, message.altitude * 1e-3)
            )

    def _begin(self) -> None:
        """The autopilot has rebooted: its clock is another."""
        self._segment = self._clock.n_segments
        self._latest = {quantity: (-1, t_ns) for quantity, (_, t_ns) in self._latest.items()}
        self._stamps.clear()
        self._wild = ""
        self.positions.restart()

    def _drop(self, what: str, now_ns: int, detail: str) -> None:
        self.n_dropped[what] += 1
        self._warn_once(what, now_ns, detail)

    def _warn_once(self, what: str, now_ns: int, detail: str) -> None:
        """Warn, rate-limited."""
        if now_ns - self._warned_ns.get(what, -WARN_AGAIN_NS) >= WARN_AGAIN_NS:
            self._warned_ns[what] = now_ns
            self._warn(Warned(now_ns, what, detail))


class _Choice:
    """Selection among messages for the same quantity."""

    def __init__(self, ids: tuple[int, ...], frequent: bool) -> None:
        self._ids, self._frequent = ids, frequent
        self._counts: Counter[int] = Counter()
        self._before: Counter[int] = Counter()
        self._since_ns = 0
        self._chosen: int | None = None

    def takes(self, kind: int, now_ns: int) -> bool:
        """Count a message; whether to use it, as always for another quantity."""
        if kind not in self._ids:
            return True
        if now_ns - self._since_ns >= CHOOSE_NS:
            self._since_ns, self._before, self._counts = now_ns, self._counts, Counter()
            self._choose()
        self._counts[kind] += 1
        if self._chosen is None:
            self._chosen = kind
        return kind == self._chosen

    def _choose(self) -> None:
        present = [kind for kind in self._ids if self._before[kind]]
        if not present:
            self._chosen = None
        elif not self._frequent:
            self._chosen = present[0]
        else:
            most = max(self._before.values())
            # of those about as frequent always the same
            self._chosen = next(kind for kind in present if ABOUT * self._before[kind] >= most)


def _on_earth(content: Telemetry | GeodeticFix) -> bool:
    if isinstance(content, GeodeticFix):
        return _is_place(content.latitude_deg, content.longitude_deg)
    if isinstance(content, PositionSample):
        return bool(np.abs(content.position_ned_m).max() < MOST_AWAY_M)
    return True


def _is_place(latitude_deg: float, longitude_deg: float) -> bool:
    return abs(latitude_deg) <= 90 and abs(longitude_deg) <= 180


def _quantity(content: Telemetry | GeodeticFix) -> str:
    if isinstance(content, GeodeticFix | PositionSample):
        return content.source.value
    return type(content).__name__
