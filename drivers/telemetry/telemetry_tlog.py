"""Telemetry of a .tlog, as recorded by a companion or a ground station.

Only the autopilot's own messages, and those of a gimbal, are taken, and never a simulator's truth
(SIM_STATE, SIMSTATE, SIM2, HIL_STATE_QUATERNION): a program in flight has none.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from itertools import compress, pairwise
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.geometry.geodesy import GeoOrigin
from companion.messages import Warned
from companion.telemetry import ArmedSample, LandedSample, Telemetry
from companion.timing.log_clock import BootSegments, estimate_clock
from companion.timing.stamp_filter import steps_ahead_ns, valid_stamps
from drivers.telemetry.gimbal_messages import GIMBAL_IDS, GimbalChoice, gimbal_of, is_stamped
from drivers.telemetry.mavlink_samples import (
    ATTITUDE_IDS,
    IMU_IDS,
    READERS,
    boot_ns,
    landed,
    samples_of,
    takes_biases_off,
)
from drivers.telemetry.telemetry_log import LogContent, TelemetryCollector, is_finite
from drivers.telemetry.tlog_records import LEAST_US, MOST_US, Record, TlogRecords

AUTOPILOT_COMPONENT = mavlink.MAV_COMP_ID_AUTOPILOT1
MAX_ROUND_TRIP_NS = 2_000_000_000
BACK_US = 500_000
"""Records of several links are written by less out of order than this."""
SET = "the computer's clock was set meanwhile, and the autopilot's is not put on it well"


def read_tlog(path: Path) -> LogContent:
    """Telemetry of one vehicle's autopilot; an empty log where there is none."""
    log = path.read_bytes()
    packets = TlogRecords(log)
    found = list(packets)
    times_ns = [record.unix_us * 1000 for record in found]
    good = valid_stamps(times_ns, LEAST_US * 1000, MOST_US * 1000)
    records = list(compress(found, good))
    warnings = []
    first_ns = records[0].unix_us * 1000 if records else 0
    if packets.n_damaged:
        detail = f"{packets.n_damaged} of {len(log)} bytes of {path.name} passed over"
        warnings.append(Warned(first_ns, "damaged telemetry", detail))
    steps_us = [before.unix_us - after.unix_us for before, after in pairwise(records)]
    back_us = [step for step in steps_us if step > BACK_US]
    if back_us:
        detail = f"{len(back_us)} x in {path.name}, by {max(back_us) * 1e-6:.1f} s at most: {SET}"
        warnings.append(Warned(first_ns, "the log's time goes back", detail))
    vehicle, n_vehicles = _vehicle(records)
    if vehicle is None:
        warnings.append(Warned(first_ns, "no autopilot in the telemetry", path.name))
        return LogContent(TelemetryCollector(path.name), warnings=tuple(warnings))
    if n_vehicles > 1:
        detail = f"{n_vehicles} in {path.name}; taken is system {vehicle}"
        warnings.append(Warned(first_ns, "several vehicles in the telemetry", detail))
    return _Reader(path.name, packets, vehicle).read(records, warnings)


def _vehicle(records: Iterable[Record]) -> tuple[int | None, int]:
    """System whose autopilot sends most attitudes, and the number of such systems."""
    counts: Counter[int] = Counter()
    for record in records:
        if record.component == AUTOPILOT_COMPONENT:
            counts[record.system] += record.message_id in ATTITUDE_IDS
    flying = [system for system, n in counts.items() if n]
    # in order of system ids where two say as much
    best = max(sorted(counts), key=lambda system: counts[system], default=None)
    return best, len(flying)


class _Reader:
    def __init__(self, name: str, packets: TlogRecords, vehicle: int) -> None:
        self._packets = packets
        self._vehicle = vehicle
        self._collected = TelemetryCollector(name)
        self._exchanges: list[tuple[int, int, int, int]] = []
        self._one_way: list[tuple[int, int, int]] = []
        self._unstamped: list[Telemetry] = []
        self._gimbal = GimbalChoice()
        self._segments = BootSegments()
        self._armed: bool | None = None
        self._unix_minus_boot_ns: int | None = None
        self._less_biases = False

    def read(self, records: list[Record], warnings: list[Warned]) -> LogContent:
        mine = [
            record
            for record in records
            if record.system == self._vehicle
            and (record.component == AUTOPILOT_COMPONENT or record.message_id in GIMBAL_IDS)
        ]
        counts = Counter(record.message_id for record in mine)
        chosen = _chosen(counts)
        beats = [r for r in mine if r.message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT]
        self._less_biases = any(
            takes_biases_off(beat) for beat in map(self._packets.decode, beats) if beat is not None
        )
        for record in mine:
            if record.message_id in chosen:
                self._take(record)
        ahead_ns = steps_ahead_ns(self._one_way)
        if ahead_ns:
            by = f"{len(ahead_ns)} x in {self._collected.source}, by {max(ahead_ns) * 1e-9:.1f} s"
            detail = f"{by} at most: {SET}, unless the autopilot's stood still"
            warnings.append(Warned(records[0].unix_us * 1000, "the log's time goes ahead", detail))
        clock = estimate_clock(self._exchanges, self._one_way)
        return LogContent(
            self._collected,
            clock.host_ns if clock else None,
            clock.report if clock else None,
            tuple(warnings),
            tuple(self._unstamped),
        )

    def _take(self, record: Record) -> None:
        message = self._packets.decode(record)
        if message is None:
            self._collected.count("damaged messages left out")
            return
        receive_ns = record.unix_us * 1000
        kind = record.message_id
        if kind in GIMBAL_IDS:
            self._take_gimbal(message, receive_ns)
            return
        if kind == mavlink.MAVLINK_MSG_ID_TIMESYNC:
            self._take_timesync(message.tc1, message.ts1, receive_ns)
            return
        if kind == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            if armed is not self._armed:
                self._unstamped.append(ArmedSample(receive_ns, armed))
                self._armed = armed
            return
        if kind == mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE:
            self._unstamped.append(LandedSample(receive_ns, landed(message)))
            return
        if kind == mavlink.MAVLINK_MSG_ID_SYSTEM_TIME and message.time_unix_usec:
            self._unix_minus_boot_ns = message.time_unix_usec * 1000 - message.time_boot_ms * 10**6
        samples = samples_of(message, self._less_biases)
        remote_ns = boot_ns(message, self._unix_minus_boot_ns)
        if remote_ns is None:
            if samples:
                self._collected.count("messages without boot time left out")
            return
        segment = self._segments.segment_of(remote_ns)
        self._one_way.append((remote_ns, receive_ns, segment))
        if kind == mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN:
            self._collected.origin.setdefault(
                segment,
                GeoOrigin(
                    message.latitude * 1e-7, message.longitude * 1e-7, message.altitude * 1e-3
                ),
            )
        for sample in samples:
            self._collected.add(remote_ns, segment, sample)

    def _take_gimbal(self, message: Any, receive_ns: int) -> None:
        if not self._gimbal.takes(message, receive_ns):
            return
        sample = gimbal_of(message)
        if sample is None or not is_finite(sample):
            self._collected.count("gimbal messages without an attitude left out")
        elif is_stamped(message):
            boot_ns = message.time_boot_ms * 10**6
            self._collected.add(boot_ns, self._segments.segment_of(boot_ns), sample)
        else:
            self._unstamped.append(replace(sample, t_ns=receive_ns))

    def _take_timesync(self, tc1: int, ts1: int, receive_ns: int) -> None:
        if tc1 == 0:  # the autopilot asks, and states its own time in doing so
            segment = self._segments.segment_of(ts1)
            self._one_way.append((ts1, receive_ns, segment))
            return
        # an answer to another computer has that one's time in it, which is not the log's
        if 0 <= receive_ns - ts1 <= MAX_ROUND_TRIP_NS:
            segment = self._segments.segment_of(tc1)
            self._exchanges.append((ts1, tc1, receive_ns, segment))


def _chosen(counts: Counter[int]) -> set[int]:
    """Ids of the messages to read: one type for each quantity that several carry."""
    chosen = {
        *READERS,
        *GIMBAL_IDS,
        mavlink.MAVLINK_MSG_ID_TIMESYNC,
        mavlink.MAVLINK_MSG_ID_HEARTBEAT,
        mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE,
        mavlink.MAVLINK_MSG_ID_SYSTEM_TIME,
        mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
    }.difference(ATTITUDE_IDS, IMU_IDS)
    # of attitudes the more frequent; of IMUs the first that there is
    chosen.add(max(ATTITUDE_IDS, key=lambda kind: counts[kind]))
    chosen.update([kind for kind in IMU_IDS if counts[kind]][:1])
    return chosen
