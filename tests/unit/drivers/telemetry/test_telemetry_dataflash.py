from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from companion.geometry.transforms import quaternion_from_euler
from companion.telemetry import ArmedSample, AttitudeSample, HeightSample, PositionSample
from drivers.telemetry.telemetry_dataflash import read_dataflash
from drivers.telemetry.telemetry_log import LogContent, TelemetryLog
from tests.support.flights.logs import dataflash_format, dataflash_record

ATT, GPS, BARO, ARM, SIM = 1, 2, 3, 4, 5
HEAD = (
    dataflash_format(ATT, "ATT", "QccccccH", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw,AEKF")
    + dataflash_format(
        GPS, "GPS", "QBBIHBcLLeffffB",
        "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U",
    )
    + dataflash_format(BARO, "BARO", "QBf", "TimeUS,I,Alt")
    + dataflash_format(ARM, "ARM", "QB", "TimeUS,ArmState")
    + dataflash_format(SIM, "SIM", "Qccc", "TimeUS,Roll,Pitch,Yaw")
)  # fmt: skip
WEEK, IN_WEEK_MS = 2445, 520_075_400
UNIX_S = 315_964_800 + WEEK * 604_800 + IN_WEEK_MS / 1000 - 18


def body(seconds: int = 20) -> bytes:
    out = b""
    for k in range(seconds * 10):
        us = 10_000_000 + k * 100_000
        out += dataflash_record(ATT, "QccccccH", us, 0, 1234, 0, -2345, 0, 12000, 3)
        out += dataflash_record(SIM, "Qccc", us, 9000, 0, 0)
        out += dataflash_record(BARO, "QBf", us, 0, 0.5 * k)
        out += dataflash_record(BARO, "QBf", us, 1, -1e3)
        if k % 2 == 0:
            at_ms = IN_WEEK_MS + k * 100 - 150  # logged 150 ms after the fix
            out += dataflash_record(
                GPS, "QBBIHBcLLeffffB", us, 0, 3, at_ms, WEEK, 12, 121,
                -353632620, 1491652370, 58409, 5.0, 90.0, -1.0, 0, 1,
            )  # fmt: skip
    return out + dataflash_record(ARM, "QB", 30_000_000, 0)


def read(folder: Path, data: bytes) -> tuple[LogContent, TelemetryLog]:
    path = folder / "1.BIN"
    path.write_bytes(data)
    content = read_dataflash(path)
    host_ns = content.host_ns or (lambda remote, segment: remote)
    return content, content.collected.finish(host_ns, content.clock, content.warnings)


def test_all_of_a_log(tmp_path: Path) -> None:
    content, log = read(tmp_path, HEAD + body())
    attitudes = [s for s in log.samples if isinstance(s, AttitudeSample)]
    assert len(attitudes) == 200
    wanted = quaternion_from_euler(*np.radians([12.34, -23.45, 120.0]))
    np.testing.assert_allclose(attitudes[0].ned_from_body, wanted, atol=1e-9)
    heights = [s.height_m for s in log.samples if isinstance(s, HeightSample)]
    assert heights == [0.5 * k for k in range(200)]
    fix = next(s for s in log.samples if isinstance(s, PositionSample))
    assert fix.velocity_ned_m_s is not None
    np.testing.assert_allclose(fix.velocity_ned_m_s, [0, 5, -1], atol=1e-6)
    assert fix.sigma_horizontal_m == pytest.approx(1.21 * 1.5)
    assert log.origin is not None
    assert log.origin.latitude_deg == pytest.approx(-35.3632620)
    assert [s.armed for s in log.samples if isinstance(s, ArmedSample)] == [False]
    assert log.warnings == ()
    assert content.clock is not None
    assert log.samples[0].t_ns * 1e-9 == pytest.approx(UNIX_S, abs=0.3)


def test_without_a_fix_there_is_no_absolute_time(tmp_path: Path) -> None:
    data = HEAD + b"".join(
        dataflash_record(BARO, "QBf", 10_000_000 + k * 100_000, 0, 1.0) for k in range(10)
    )
    content, log = read(tmp_path, data)
    assert content.host_ns is None
    assert len(log.samples) == 10


def test_records_of_an_unknown_kind_end_nothing(tmp_path: Path) -> None:
    data = body()
    middle = len(data) // 2
    _, log = read(tmp_path, HEAD + data[:middle] + b"\xa3\x95\x63" + bytes(700) + data[middle:])
    assert len([s for s in log.samples if isinstance(s, AttitudeSample)]) >= 198
    assert [w.what for w in log.warnings] == ["damaged telemetry"]


def test_any_damage_is_survived(tmp_path: Path, rng: np.random.Generator) -> None:
    whole = HEAD + body(5)
    for _ in range(60):
        damaged = bytearray(whole)
        for at in rng.integers(0, len(whole), 20):
            damaged[at] = rng.integers(0, 256)
        _, log = read(tmp_path, bytes(damaged[: -int(rng.integers(1, 500))]))
        assert all(np.diff([s.t_ns for s in log.samples]) >= 0)


def test_a_wild_time_is_left_out(tmp_path: Path) -> None:
    wild = dataflash_record(BARO, "QBf", 2**60, 0, -7.25)
    _, log = read(
        tmp_path, HEAD + body(2) + wild + dataflash_record(BARO, "QBf", 30_100_000, 0, 8.25)
    )
    heights = [s.height_m for s in log.samples if isinstance(s, HeightSample)]
    assert -7.25 not in heights
    assert 8.25 in heights
