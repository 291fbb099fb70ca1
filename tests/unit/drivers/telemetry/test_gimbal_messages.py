"""Angles of gimbals from the link and from logs: axes by the flags, clocks, choice of one."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import LinkConfig
from companion.geometry.transforms import quaternion_from_euler
from companion.messages import Warned
from companion.telemetry import GimbalSample, Telemetry
from companion.timing.link_clock import ClockFilter
from drivers.telemetry.gimbal_messages import GIMBAL_IDS, GimbalChoice, gimbal_of
from drivers.telemetry.live_samples import LiveSamples
from drivers.telemetry.mavlink_samples import wanted
from drivers.telemetry.telemetry_csv import read_telemetry_csv, telemetry_csv
from drivers.telemetry.telemetry_dataflash import read_dataflash
from drivers.telemetry.telemetry_log import TelemetryLog
from drivers.telemetry.telemetry_tlog import read_tlog
from drivers.telemetry.telemetry_ulog import read_ulog
from tests.support.flights.logs import (
    START_NS,
    Tlog,
    attitude,
    dataflash_format,
    dataflash_record,
    ulog_message,
)

S = 10**9
LOCK, VEHICLE, EARTH = 16, 32, 64
ANGLES = 0.1, -0.7, 1.2
Q = quaternion_from_euler(*ANGLES)
DEVICE = 154


def device(
    flags: int = VEHICLE, q: Any = Q, failures: int = 0, boot_ms: int = 80_000, number: int = 0
) -> Any:
    nan = math.nan
    return mavlink.MAVLink_gimbal_device_attitude_status_message(
        0, 0, boot_ms, flags, [float(v) for v in q], nan, nan, nan, failures, nan, nan, number
    )


def degrees(sample: GimbalSample | None) -> list[float]:
    assert sample is not None
    w, x, y, z = sample.level_from_head
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return [math.degrees(v) for v in (roll, math.asin(2 * (w * y - z * x)), yaw)]


@pytest.mark.parametrize(
    ("flags", "from_north"),
    [
        (VEHICLE, False), (EARTH, True), (0, False), (LOCK, True), (LOCK | VEHICLE, False),
        (EARTH | 12, True), (4 | 8, False),
    ],
)  # fmt: skip
def test_the_axes_of_the_yaw_are_as_the_flags_say(flags: int, from_north: bool) -> None:
    found = gimbal_of(device(flags))
    assert found is not None and found.yaw_from_north is from_north
    assert degrees(found) == pytest.approx([math.degrees(v) for v in ANGLES], abs=1e-4)


@pytest.mark.parametrize(
    "message",
    [
        device(VEHICLE | EARTH), device(q=[0, 0, 0, 0]), device(q=[math.nan] * 4),
        device(failures=8), device(failures=128), device(failures=256),
        mavlink.MAVLink_mount_orientation_message(1, math.nan, 0, 0),
    ],
)  # fmt: skip
def test_angles_that_mean_nothing_are_none(message: Any) -> None:
    assert gimbal_of(message) is None


def test_a_gimbal_at_its_limit_still_tells_its_angles() -> None:
    assert gimbal_of(device(failures=2 | 4)) is not None


def test_older_messages_are_from_the_vehicle_heading() -> None:
    orientation = mavlink.MAVLink_mount_orientation_message(1, 1.0, -30.0, 20.0, 200.0)
    status = mavlink.MAVLink_mount_status_message(0, 0, -3000, 100, 2000)
    for message in (orientation, status):
        found = gimbal_of(message)
        assert found is not None and not found.yaw_from_north
        assert degrees(found) == pytest.approx([1.0, -30.0, 20.0])


class Link:
    """What comes of messages live."""

    def __init__(self) -> None:
        self.clock, self.live, self.warned = ClockFilter(), list[Telemetry](), list[Warned]()
        self._samples = LiveSamples(self.clock, self.live.append, self.warned.append)
        self._codecs: dict[int, Any] = {}
        for k in range(50):
            t_ns = START_NS + k * S // 50
            self.clock.exchange(t_ns, 80 * S + k * S // 50, t_ns)

    def take(self, message: Any, receive_ns: int, component: int = 1) -> None:
        codec = self._codecs.setdefault(component, mavlink.MAVLink(None, 1, component))
        self._samples.take_gimbal(codec.decode(bytearray(message.pack(codec))), receive_ns)

    @property
    def times_ns(self) -> list[int]:
        return [each.t_ns - START_NS for each in self.live]


def test_by_the_autopilot_its_clock_counts_and_of_a_gimbal_the_arrival() -> None:
    link = Link()
    link.take(device(boot_ms=80_500), START_NS + S)
    assert link.times_ns == pytest.approx([S // 2], abs=1e6)
    other = Link()
    other.take(device(boot_ms=12_345), START_NS + S, DEVICE)
    other.take(mavlink.MAVLink_mount_status_message(0, 0, 0, 0, 0), START_NS + 4 * S)
    assert other.times_ns == [S, 4 * S]


def test_what_is_late_out_of_order_or_wrong_is_dropped() -> None:
    link = Link()
    link.take(device(boot_ms=80_500), START_NS + S)
    link.take(device(boot_ms=80_400), START_NS + S)
    link.take(device(boot_ms=90_000), START_NS + S)
    link.take(device(q=[math.nan] * 4), START_NS + S)
    assert len(link.live) == 1
    assert {each.what for each in link.warned} == {
        "telemetry out of order", "telemetry from the future", "telemetry that is not usable",
    }  # fmt: skip


def test_one_gimbal_is_chosen_and_the_better_message() -> None:
    choice, codec = GimbalChoice(), mavlink.MAVLink(None, 1, 1)

    def takes(message: Any, at_s: float) -> bool:
        decoded = codec.decode(bytearray(message.pack(codec)))
        return choice.takes(decoded, round(at_s * S))

    status = mavlink.MAVLink_mount_status_message(0, 0, 0, 0, 0)
    assert takes(status, 1.0)
    assert takes(device(number=1), 1.1)
    assert not takes(status, 1.2)
    assert not takes(device(number=2), 1.3)
    assert takes(device(number=1), 2.0)
    assert takes(device(number=2), 4.5)


def test_it_is_requested_of_a_camera_on_a_gimbal_alone() -> None:
    config = LinkConfig()
    assert not any(each.ids == GIMBAL_IDS for each in wanted(config))
    asked = [each for each in wanted(config, on_gimbal=True) if each.ids == GIMBAL_IDS]
    assert [each.rate_hz for each in asked] == [20.0] and not asked[0].always


def test_of_a_tlog(tmp_path: Path) -> None:
    log = Tlog()
    for k in range(100):
        boot_ns, t_ns = 80 * S + k * S // 50, START_NS + k * S // 50
        log.add(t_ns, attitude(boot_ns, 0, 0, 0))
        if k % 5 == 0:
            log.add(t_ns, device(EARTH, boot_ms=7 + k), component=DEVICE)
            log.add(t_ns, device(EARTH, boot_ms=7 + k), system=9, component=DEVICE)
    (tmp_path / "telemetry.tlog").write_bytes(log.data)
    content = read_tlog(tmp_path / "telemetry.tlog")
    assert content.host_ns is not None
    logged = content.collected.finish(content.host_ns, None, (), content.on_host_clock)
    found = [each for each in logged.samples if isinstance(each, GimbalSample)]
    assert [each.t_ns - START_NS for each in found] == [k * S // 50 for k in range(0, 100, 5)]
    assert all(each.yaw_from_north for each in found)


def test_of_a_dataflash_log(tmp_path: Path) -> None:
    columns = "TimeUS,I,DesRoll,Roll,DesPitch,Pitch,DesYawB,YawB,DesYawE,YawE"
    log = dataflash_format(90, "MNT", "QBffffffff", columns)
    nan = math.nan
    for k in range(20):
        rows = (0.0, 1.0, 0.0, -30.0, 0.0, 20.0 if k % 2 else nan, 0.0, 200.0)
        log += dataflash_record(90, "QBffffffff", 10**6 + k * 50_000, 0, *rows)
        log += dataflash_record(90, "QBffffffff", 10**6 + k * 50_000, 1, *rows)
    path = tmp_path / "00000001.BIN"
    path.write_bytes(log)
    found = read_dataflash(path).collected.finish(lambda t_ns, _: t_ns, None).samples
    assert len(found) == 20
    assert [each.yaw_from_north for each in found if isinstance(each, GimbalSample)][:2] == [
        True, False,
    ]  # fmt: skip
    assert isinstance(found[1], GimbalSample)
    assert degrees(found[1]) == pytest.approx([1.0, -30.0, 20.0], abs=1e-4)


def test_of_a_ulog(tmp_path: Path) -> None:
    log = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
    log += ulog_message("B", bytes(40))
    log += ulog_message(
        "F", b"gimbal_device_attitude_status:uint64_t timestamp;float[4] q;"
        b"uint32_t failure_flags;uint16_t device_flags;",
    )  # fmt: skip
    log += ulog_message("A", struct.pack("<BH", 0, 1) + b"gimbal_device_attitude_status")
    for k in range(10):
        body = struct.pack("<HQ4fIH", 1, 10**6 + k * 50_000, *Q, 8 if k == 3 else 0, EARTH)
        log += ulog_message("D", body)
    path = tmp_path / "flight.ulg"
    path.write_bytes(log)
    found = read_ulog(path).collected.finish(lambda t_ns, _: t_ns, None).samples
    assert len(found) == 9
    assert all(isinstance(each, GimbalSample) and each.yaw_from_north for each in found)


def test_it_is_tabulated(tmp_path: Path) -> None:
    table = tmp_path / "telemetry.csv"
    sample = GimbalSample(5, Q, True)
    table.write_text("".join(telemetry_csv(TelemetryLog("", [sample]))))
    back = read_telemetry_csv(table).collected.finish(lambda times, _: times, None).samples
    assert len(back) == 1 and isinstance(back[0], GimbalSample)
    np.testing.assert_array_equal(back[0].level_from_head, Q)
    assert back[0].yaw_from_north and back[0].t_ns == 5
