from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.geometry.transforms import (
    rotation_from_quaternion,
    rotation_from_vector,
    yaw_rotation,
)
from companion.telemetry import (
    ArmedSample,
    AttitudeSample,
    HeightSample,
    ImuSample,
    PositionSample,
    PositionSource,
    RangeSample,
    Telemetry,
)
from drivers.telemetry.telemetry_log import TelemetryLog
from drivers.telemetry.telemetry_tlog import read_tlog
from tests.support.flights.logs import START_NS, Tlog, attitude, heartbeat

S = 10**9
BOOT_NS = 83 * S
ROLL, PITCH, YAW = 0.1, -0.4, 2.0
Kind = TypeVar("Kind", bound=Telemetry)


def read(folder: Path, log: Tlog) -> TelemetryLog:
    path = folder / "telemetry.tlog"
    path.write_bytes(log.data)
    content = read_tlog(path)
    return content.collected.finish(
        content.host_ns or (lambda remote, segment: remote),
        content.clock,
        content.warnings,
        content.on_host_clock,
    )


def of(log: TelemetryLog, kind: type[Kind]) -> list[Kind]:
    return [sample for sample in log.samples if isinstance(sample, kind)]


def positions(log: TelemetryLog, source: PositionSource) -> list[PositionSample]:
    return [sample for sample in of(log, PositionSample) if sample.source is source]


def said(folder: Path, *messages: Any) -> TelemetryLog:
    log = Tlog()
    log.add(START_NS, heartbeat(False))
    for message in messages:
        log.add(START_NS, message)
    return read(folder, log)


def flying(seconds: float = 5.0, **ids: int) -> Tlog:
    log = Tlog()
    log.add(START_NS, heartbeat(False), **ids)
    for t_ns in range(0, int(seconds * S), S // 50):
        log.add(START_NS + t_ns + 3_000_000, attitude(BOOT_NS + t_ns, ROLL, PITCH, YAW), **ids)
    return log


def test_an_asymmetric_attitude(tmp_path: Path) -> None:
    log = read(tmp_path, flying())
    sample = of(log, AttitudeSample)[0]
    wanted = (
        yaw_rotation(YAW)
        @ rotation_from_vector(np.array([0, PITCH, 0]))
        @ rotation_from_vector(np.array([ROLL, 0, 0]))
    )
    np.testing.assert_allclose(rotation_from_quaternion(sample.ned_from_body), wanted, atol=1e-6)
    assert sample.rates_body_rad_s is not None
    np.testing.assert_allclose(sample.rates_body_rad_s, [0.1, 0.2, 0.3], atol=1e-6)
    assert abs(sample.t_ns - START_NS - 3_000_000) < 1_000_000


def test_the_same_attitude_is_not_read_twice(tmp_path: Path) -> None:
    log = flying()
    for t_ns in range(0, 5 * S, S // 50):
        quaternion = mavlink.MAVLink_attitude_quaternion_message(
            (BOOT_NS + t_ns) // 10**6, -0.5, 0.5, -0.5, 0.5, 0, 0, 0
        )
        log.add(START_NS + t_ns, quaternion)
    found = of(read(tmp_path, log), AttitudeSample)
    assert len(found) == 250
    np.testing.assert_allclose(found[0].ned_from_body, [0.5, -0.5, 0.5, -0.5])


def test_a_gimbal_and_another_vehicle_are_told_apart(tmp_path: Path) -> None:
    log = flying()
    for t_ns in range(0, 5 * S, S // 100):
        other = attitude(BOOT_NS + t_ns, 1.0, 1.0, 1.0)
        log.add(START_NS + t_ns, other, component=154)
        log.add(START_NS + t_ns, other, system=255, component=190)
    for t_ns in range(0, S, S // 50):
        log.add(START_NS + t_ns, attitude(t_ns, 1.0, 1.0, 1.0), system=2)
    read_back = read(tmp_path, log)
    assert len(of(read_back, AttitudeSample)) == 250
    assert all(abs(s.ned_from_body[0] - 0.52) < 0.02 for s in of(read_back, AttitudeSample))
    assert [w.what for w in read_back.warnings] == ["several vehicles in the telemetry"]


def test_truth_of_a_simulator_is_not_read(tmp_path: Path) -> None:
    log = flying()
    for t_ns in range(0, 5 * S, S // 50):
        log.add(START_NS + t_ns, mavlink.MAVLink_simstate_message(*[1.0] * 9, 1, 1))
        truth = mavlink.MAVLink_hil_state_quaternion_message(
            (BOOT_NS + t_ns) // 1000, [1, 0, 0, 0], 0, 0, 0, 10**8, 10**8, 0, 0, 0, 0, 0, 0, 0, 0, 0
        )
        log.add(START_NS + t_ns, truth)
    assert set(read(tmp_path, log).rates_hz) == {"attitude", "armed"}


def test_timesync(tmp_path: Path) -> None:
    """The messages are 30 ms late; the exchanges know."""
    log = Tlog()
    log.add(START_NS, heartbeat(False))
    for t_ns in range(0, 20 * S, S // 10):
        sent, received = START_NS + t_ns - 2_000_000, START_NS + t_ns + 2_000_000
        log.add(received, mavlink.MAVLink_timesync_message(BOOT_NS + t_ns, sent))
        # another computer's exchange: its time is not ours
        log.add(received, mavlink.MAVLink_timesync_message(BOOT_NS + t_ns, 5 * S + t_ns))
        log.add(START_NS + t_ns + 30_000_000, attitude(BOOT_NS + t_ns, 0, 0, 0))
    read_back = read(tmp_path, log)
    assert read_back.clock is not None
    assert read_back.clock.method == "TIMESYNC"
    assert read_back.clock.offset_s == pytest.approx((START_NS - BOOT_NS) / S, abs=1e-3)
    assert abs(of(read_back, AttitudeSample)[0].t_ns - START_NS) < 1e6


def test_a_clock_that_was_set_back_while_it_recorded_is_told(tmp_path: Path) -> None:
    assert read(tmp_path, flying(4.0)).warnings == ()
    log = Tlog(flying(4.0).data)
    for t_ns in range(4 * S, 8 * S, S // 50):
        log.add(START_NS + t_ns - 3 * S, attitude(BOOT_NS + t_ns, ROLL, PITCH, YAW))
    told = {warned.what: warned.detail for warned in read(tmp_path, log).warnings}
    assert "1 x in telemetry.tlog, by 3.0 s" in told["the log's time goes back"]


def test_a_clock_that_was_set_ahead_is_told_and_a_stalled_link_is_not(tmp_path: Path) -> None:
    stalled, ahead = Tlog(flying(4.0).data), Tlog(flying(4.0).data)
    for t_ns in range(4 * S, 20 * S, S // 50):
        message = attitude(BOOT_NS + t_ns, ROLL, PITCH, YAW)
        stalled.add(START_NS + max(t_ns, 7 * S), message)
        ahead.add(START_NS + t_ns + 7200 * S, message)
    assert read(tmp_path, stalled).warnings == ()
    told = {warned.what: warned.detail for warned in read(tmp_path, ahead).warnings}
    assert "1 x in telemetry.tlog, by 7200.0 s" in told["the log's time goes ahead"]


def test_a_reboot(tmp_path: Path) -> None:
    log = flying()
    for t_ns in range(0, 5 * S, S // 50):
        log.add(START_NS + 20 * S + t_ns, attitude(S + t_ns, 0, 0, 0))
    read_back = read(tmp_path, log)
    assert read_back.clock is not None
    assert read_back.clock.n_reboots == 1
    times = np.array([sample.t_ns for sample in of(read_back, AttitudeSample)])
    assert len(times) == 500
    assert abs(times[0] - START_NS) < 5e6
    assert abs(times[-1] - START_NS - 25 * S + S // 50) < 5e6


def test_garbage_costs_no_more_than_it_hit(tmp_path: Path, rng: np.random.Generator) -> None:
    rest = Tlog()
    for t_ns in range(0, 2 * S, S // 50):
        rest.add(START_NS + 2 * S + t_ns, attitude(BOOT_NS + 2 * S + t_ns, 0, 0, 0))
    damaged = rest.data[:1000] + b"\x55" + rest.data[1001:-7]
    read_back = read(tmp_path, Tlog(flying(2).data + rng.bytes(5000) + damaged))
    assert 195 <= len(of(read_back, AttitudeSample)) <= 199
    assert "damaged telemetry" in [w.what for w in read_back.warnings]


def test_any_damage_is_survived(tmp_path: Path, rng: np.random.Generator) -> None:
    whole = flying(1).data
    for _ in range(60):
        damaged = bytearray(whole)
        for at in rng.integers(0, len(whole), 20):
            damaged[at] = rng.integers(0, 256)
        first, last = int(rng.integers(0, 200)), -int(rng.integers(1, 200))
        log = read(tmp_path, Tlog(bytes(damaged[first:last])))
        assert len(of(log, AttitudeSample)) > 5
        assert all(abs(sample.t_ns - START_NS) < 70 * S for sample in log.samples)


def test_numbers_that_are_none(tmp_path: Path) -> None:
    log = flying(1)
    log.add(START_NS + S, attitude(BOOT_NS + S, float("nan"), 0, 0))
    quaternion = mavlink.MAVLink_local_position_ned_message(83_500, 1, 2, float("inf"), 0, 0, 0)
    log.add(START_NS + S, quaternion)
    read_back = read(tmp_path, log)
    assert len(of(read_back, AttitudeSample)) == 50
    assert not of(read_back, PositionSample)
    (warned,) = read_back.warnings
    assert warned.detail == "2 times"


def test_positions_of_all_sources_share_an_origin(tmp_path: Path) -> None:
    log = Tlog()
    log.add(START_NS, heartbeat(False))
    for t_ms in range(83_000, 88_000, 100):
        at = START_NS + (t_ms - 83_000) * 10**6
        log.add(at, mavlink.MAVLink_local_position_ned_message(t_ms, 100, -50, -20, 1, 2, 3))
        log.add(
            at,
            mavlink.MAVLink_global_position_int_message(
                t_ms, -353632620, 1491652370, 604_090, 20_000, 100, 200, 300, 0
            ),
        )
        gps = mavlink.MAVLink_gps_raw_int_message(
            t_ms * 1000, 3, -353632620, 1491652370, 604_090, 80, 120, 500, 9000, 12
        )
        log.add(at, gps)
    read_back = read(tmp_path, log)
    for source in PositionSource:
        found = positions(read_back, source)
        assert len(found) == 50
        np.testing.assert_allclose(found[0].position_ned_m, [100, -50, -20], atol=0.05)
    assert read_back.origin is not None
    assert read_back.origin.altitude_m == pytest.approx(584.09, abs=0.01)
    local, anywhere, gps_sample = (positions(read_back, source)[0] for source in PositionSource)
    assert local.velocity_ned_m_s is not None
    assert anywhere.velocity_ned_m_s is not None
    assert gps_sample.velocity_ned_m_s is not None
    np.testing.assert_allclose(local.velocity_ned_m_s, [1, 2, 3])
    np.testing.assert_allclose(anywhere.velocity_ned_m_s, [1, 2, 3])
    np.testing.assert_allclose(gps_sample.velocity_ned_m_s, [0, 5, np.nan], atol=1e-9)
    assert gps_sample.sigma_horizontal_m == pytest.approx(1.2)


def test_units_of_imu_range_height(tmp_path: Path) -> None:
    scaled = mavlink.MAVLink_scaled_imu2_message(83_000, 100, -200, -1000, 10, -20, 30, 0, 0, 0)
    down = mavlink.MAVLink_distance_sensor_message(83_010, 20, 4000, 1234, 0, 0, 25, 0)
    pressure = mavlink.MAVLink_scaled_pressure_message(83_020, 898.746, 0, 2000)
    log = said(tmp_path, scaled, down, pressure)
    (imu,) = of(log, ImuSample)
    np.testing.assert_allclose(imu.accel_m_s2, [0.980665, -1.96133, -9.80665])
    np.testing.assert_allclose(imu.gyro_rad_s, [0.01, -0.02, 0.03])
    assert [sample.distance_m for sample in of(log, RangeSample)] == [12.34]
    # 898.746 hPa is 1000 m in the standard atmosphere
    assert of(log, HeightSample)[0].height_m == pytest.approx(1000, abs=0.5)


def test_an_imu_message_that_holds_no_imu(tmp_path: Path) -> None:
    def highres(usec: int, fields: int) -> Any:
        return mavlink.MAVLink_highres_imu_message(
            usec, 1, 2, 3, 0.1, 0.2, 0.3, 0, 0, 0, 900, 0, 0, 20, fields
        )

    log = said(tmp_path, highres(83_000_000, 0x3F), highres(83_010_000, 0x1E00))
    (imu,) = of(log, ImuSample)
    np.testing.assert_allclose(imu.accel_m_s2, [1, 2, 3])
    np.testing.assert_allclose(imu.gyro_rad_s, [0.1, 0.2, 0.3], atol=1e-7)


@pytest.mark.parametrize(
    ("autopilot", "marked"),
    [(mavlink.MAV_AUTOPILOT_PX4, True), (mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, False)],
)
def test_the_imu_that_px4_takes_its_biases_off_is_marked(
    tmp_path: Path, autopilot: int, marked: bool
) -> None:
    """From the first sample on, though the first HEARTBEAT comes later; SCALED_IMU never is."""
    log, zeros = Tlog(), [0] * 9
    log.add(START_NS, mavlink.MAVLink_highres_imu_message(83_000_000, *zeros, 900, 0, 0, 20, 0x3F))
    log.add(START_NS, heartbeat(False, autopilot))
    (imu,) = of(read(tmp_path, log), ImuSample)
    assert imu.less_biases is marked
    log = Tlog()
    log.add(START_NS, heartbeat(False, autopilot))
    log.add(START_NS, mavlink.MAVLink_scaled_imu_message(83_000, *zeros, 0))
    (imu,) = of(read(tmp_path, log), ImuSample)
    assert not imu.less_biases


@pytest.mark.parametrize(
    ("orientation", "distance"), [(0, 1000), (25, 0), (25, 10), (25, 4000), (25, 65535)]
)
def test_ranges_that_say_nothing(tmp_path: Path, orientation: int, distance: int) -> None:
    sensor = mavlink.MAVLink_distance_sensor_message(
        83_000, 20, 4000, distance, 0, 0, orientation, 0
    )
    assert not of(said(tmp_path, sensor), RangeSample)


def test_arming(tmp_path: Path) -> None:
    log = flying(1)
    for second, armed in enumerate([False, True, True, False]):
        log.add(START_NS + second * S, heartbeat(armed))
    found = of(read(tmp_path, log), ArmedSample)
    assert [(s.armed, (s.t_ns - START_NS) // S) for s in found] == [
        (False, 0), (True, 1), (False, 3),
    ]  # fmt: skip
