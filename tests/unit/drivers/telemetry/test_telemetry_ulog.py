from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from companion.telemetry import (
    ArmedSample,
    AttitudeSample,
    PositionSample,
    PositionSource,
    RangeSample,
)
from drivers.telemetry.telemetry_log import LogContent, TelemetryLog
from drivers.telemetry.telemetry_ulog import read_ulog
from tests.support.flights.logs import START_NS, ulog_message

FORMATS = (
    "vehicle_attitude:uint64_t timestamp;uint64_t timestamp_sample;float[4] q;",
    "vehicle_local_position:uint64_t timestamp;double ref_lat;double ref_lon;float ref_alt;"
    "float x;float y;float z;float vx;float vy;float vz;bool xy_valid;bool z_valid;"
    "bool v_xy_valid;bool v_z_valid;bool xy_global;bool z_global;",
    "sensor_gps:uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;int32_t alt;"
    "float eph;float epv;float vel_n_m_s;float vel_e_m_s;float vel_d_m_s;uint8_t fix_type;"
    "bool vel_ned_valid;",
    "distance_sensor:uint64_t timestamp;float current_distance;float min_distance;"
    "float max_distance;uint8_t orientation;",
    "vehicle_status:uint64_t timestamp;uint8_t arming_state;",
)
HEAD = (
    b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
    + ulog_message("B", bytes(40))
    + b"".join(ulog_message("F", text.encode()) for text in FORMATS)
    + b"".join(
        ulog_message("A", struct.pack("<BH", 0, number) + text.split(":")[0].encode())
        for number, text in enumerate(FORMATS)
    )
)  # fmt: skip


def data(number: int, form: str, *values: float) -> bytes:
    return ulog_message("D", struct.pack("<H" + form, number, *values))


def body(seconds: int = 10, utc: bool = True) -> bytes:
    out = b""
    for k in range(seconds * 10):
        us = 5_000_000 + k * 100_000
        out += data(0, "QQ4f", us, us - 2000, -0.5, 0.5, -0.5, 0.5)
        moved = 0.001 if k >= 50 else 0.0  # the estimator takes another origin: 111 m to the north
        out += data(
            1, "Qddf6f6?", us, 47.0 + moved, 8.0, 500.0, 1, 2, -3, 4, 5, 6,
            True, True, True, True, True, True,
        )  # fmt: skip
        stamp = (START_NS // 1000 + k * 100_000) if utc else 0
        out += data(
            2, "QQ3i5fB?", us, stamp, 470_000_000, 80_000_000, 503_000, 0.8, 1.2, 1, 2, 3, 3, True
        )
        out += data(3, "Q3fB", us, [7.5, 0.05, 40.0][k % 3], 0.1, 40.0, 25)
        out += data(4, "QB", us, 2 if k >= 20 else 1)
    return out


def read(folder: Path, content: bytes) -> tuple[LogContent, TelemetryLog]:
    path = folder / "log.ulg"
    path.write_bytes(content)
    found = read_ulog(path)
    host_ns = found.host_ns or (lambda remote, segment: remote)
    return found, found.collected.finish(host_ns, found.clock, found.warnings)


def test_all_of_a_log(tmp_path: Path) -> None:
    content, log = read(tmp_path, HEAD + body())
    attitudes = [s for s in log.samples if isinstance(s, AttitudeSample)]
    assert len(attitudes) == 100
    np.testing.assert_allclose(attitudes[0].ned_from_body, [0.5, -0.5, 0.5, -0.5])
    # by the time at which it was measured, not published
    assert attitudes[0].t_ns == pytest.approx(START_NS - 2_000_000, abs=2e6)
    assert {s.distance_m for s in log.samples if isinstance(s, RangeSample)} == {7.5}
    armed = [s for s in log.samples if isinstance(s, ArmedSample)]
    assert [s.armed for s in armed] == [False, True]
    assert content.clock is not None
    assert content.clock.method == "UTC of the log"
    assert log.origin is not None
    assert log.origin.latitude_deg == pytest.approx(47.0)


def test_local_positions_of_a_moved_origin(tmp_path: Path) -> None:
    _, log = read(tmp_path, HEAD + body())
    local = [
        s for s in log.samples if isinstance(s, PositionSample) and s.source is PositionSource.LOCAL
    ]
    assert len(local) == 100
    np.testing.assert_allclose(local[0].position_ned_m, [1, 2, -3])
    np.testing.assert_allclose(local[-1].position_ned_m, [112.2, 2, -3], atol=0.05)
    assert local[0].velocity_ned_m_s is not None
    np.testing.assert_allclose(local[0].velocity_ned_m_s, [4, 5, 6])


def test_gps_about_the_same_origin(tmp_path: Path) -> None:
    _, log = read(tmp_path, HEAD + body())
    fix = next(
        s for s in log.samples if isinstance(s, PositionSample) and s.source is PositionSource.GPS
    )
    np.testing.assert_allclose(fix.position_ned_m, [0, 0, -3], atol=1e-4)
    assert (fix.sigma_horizontal_m, fix.sigma_vertical_m) == pytest.approx((0.8, 1.2))


def test_without_utc_there_is_no_absolute_time(tmp_path: Path) -> None:
    content, log = read(tmp_path, HEAD + body(utc=False))
    assert content.host_ns is None
    assert log.samples


def test_any_damage_is_survived(tmp_path: Path, rng: np.random.Generator) -> None:
    whole = HEAD + body(2)
    for _ in range(60):
        damaged = bytearray(whole)
        for at in rng.integers(0, len(whole), 8):
            damaged[at] = rng.integers(0, 256)
        _, log = read(tmp_path, bytes(damaged[: -int(rng.integers(1, 500))]))
        assert all(np.diff([s.t_ns for s in log.samples]) >= 0)
