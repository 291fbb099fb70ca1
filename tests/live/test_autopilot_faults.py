"""Faults of the autopilot's link in flight: no bad pose, a warning, and recovery.

The link is a serial port (a pty). The flight lasts as long as the daemon runs, so that one serves
all of these.
"""

from __future__ import annotations

import random
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.support.processes.flying import Flying, source

LASTS_S = 2.0
"""Of what goes on for a while."""
JUMPS = """
import os, sys, time
told, real_ns = sys.argv.pop(1), time.time_ns
def time_ns():
    return real_ns() + (3_600_000_000_000 if os.path.exists(told) else 0)
time.time_ns, time.time = time_ns, lambda: time_ns() * 1e-9
from companion.__main__ import main
sys.exit(main())
"""
"""The daemon on a machine whose clock is set an hour ahead as soon as a file is there."""


@pytest.fixture(scope="module")
def clock_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("clock") / "an_hour_ahead"


@pytest.fixture(scope="module")
def flying(tmp_path_factory: pytest.TempPathFactory, clock_set: Path) -> Iterator[Flying]:
    folder = tmp_path_factory.mktemp("autopilot")
    with Flying(
        folder, "daemon.flight=always", "recorder.enabled=false",
        url=f"pty:{folder}/flight_controller:921600", program=("-c", JUMPS, str(clock_set)),
    ) as begun:  # fmt: skip
        begun.until_source("autopilot", "running")
        begun.until_sending()
        yield begun


def test_silent_for_five_seconds(flying: Flying) -> None:
    flying.until_sending()
    silent_ns = time.monotonic_ns()
    flying.autopilot.silent = True
    try:
        flying.daemon.line("autopilot silent", after_ns=silent_ns)
        flying.until_source("autopilot", "silent")
        # nobody listens: nothing is said but heartbeats that ask for an answer
        quiet_ns = time.monotonic_ns() + 100_000_000
        time.sleep(max(0.0, 5.0 - (time.monotonic_ns() - silent_ns) * 1e-9))
        assert len(flying.poses.between(quiet_ns, 2**62)) == 0
    finally:
        flying.autopilot.silent = False
    heard_ns = time.monotonic_ns()
    flying.until_source("autopilot", "running")
    flying.assert_soon(heard_ns, time.monotonic_ns())
    flying.daemon.line("autopilot heard again", after_ns=heard_ns)
    flying.assert_resumed(heard_ns)
    flying.assert_true_poses()


def test_rebooted(flying: Flying) -> None:
    flying.until_sending()
    began_ns = time.monotonic_ns()
    flying.autopilot.reboot(silent_s=0.5)
    booted_ns = began_ns + 500_000_000
    line = flying.daemon.line("autopilot rebooted", after_ns=began_ns)
    flying.assert_soon(booted_ns, line.monotonic_ns)
    flying.until_told("autopilot reboot detected", booted_ns)
    # it has forgotten what it was asked to send
    flying.daemon.until(
        lambda health: source(health, "autopilot")["state"] == "running"
        and flying.autopilot.rates_hz.get("ATTITUDE_QUATERNION", 0) > 20,
        "asked again for what is wanted",
    )  # fmt: skip
    flying.assert_soon(booted_ns, time.monotonic_ns(), 3.0)
    flying.assert_resumed(booted_ns)
    flying.assert_true_poses()


def test_damaged_bytes(flying: Flying) -> None:
    """Garbage, packets that are cut short, longer than they may be, or with a wrong checksum."""
    flying.until_sending()
    began_ns, rng = time.monotonic_ns(), random.Random(1)
    until_s = time.monotonic() + LASTS_S
    while time.monotonic() < until_s:
        packet = bytearray(rng.choice(flying.autopilot.last_packets))
        packet[-1] ^= 0x55
        oversized = bytes([0xFD, 255, 0, 0, 0, 1, 1, 30, 0, 0]) + rng.randbytes(300)
        for data in (rng.randbytes(200), packet[: len(packet) // 2], packet, oversized):
            flying.autopilot.send_bytes(bytes(data))
        time.sleep(0.02)
    flying.daemon.line("damaged data on the autopilot's link", after_ns=began_ns)
    flying.assert_went_on(began_ns)
    flying.daemon.until(
        lambda health: health["n_warnings"].get("damaged data on the autopilot's link"), "counted"
    )
    assert flying.until_source("autopilot", "running")
    flying.assert_true_poses()


def test_replayed_and_out_of_order_stamps(flying: Flying) -> None:
    flying.until_sending()
    began_ns, recorded = time.monotonic_ns(), list(flying.autopilot.last_packets)
    n_dropped = flying.until_source("autopilot", "running")["n_dropped"]
    rng = random.Random(2)
    until_s = time.monotonic() + LASTS_S
    while time.monotonic() < until_s:
        for packet in rng.sample(recorded, 5):
            flying.autopilot.send_bytes(packet)
        # half a minute old, and from the other side of the circle
        then_ms = flying.autopilot.boot_ns() // 10**6 - 30_000
        flying.autopilot.send(mavlink.MAVLink_attitude_quaternion_message(
            max(then_ms, 0), 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0
        ))  # fmt: skip
        time.sleep(0.02)
    flying.daemon.line("telemetry", after_ns=began_ns)
    assert flying.until_source("autopilot", "running")["n_dropped"] > n_dropped + 50
    flying.assert_went_on(began_ns)
    assert not [line for line in flying.daemon.said("rebooted") if line.monotonic_ns > began_ns]
    flying.assert_true_poses()


def test_another_vehicle_on_the_link(flying: Flying) -> None:
    """It says that it is upside down, elsewhere, disarmed, and that it is another time."""
    flying.until_sending()
    began_ns = time.monotonic_ns()
    until_s = time.monotonic() + LASTS_S
    while time.monotonic() < until_s:
        for message in (
            mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3),
            mavlink.MAVLink_attitude_quaternion_message(5, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            mavlink.MAVLink_local_position_ned_message(5, 1e3, 1e3, -1e3, 9.0, 9.0, 9.0),
            mavlink.MAVLink_timesync_message(7_000_000_000, time.monotonic_ns()),
        ):
            flying.autopilot.send(message, system=2)
        time.sleep(0.02)
    flying.daemon.line("another vehicle on the link: system 2 is ignored", after_ns=began_ns)
    flying.assert_went_on(began_ns)
    assert {each.message.get_srcSystem() for each in flying.autopilot.of("ODOMETRY")} == {1}
    flying.assert_true_poses()


def test_a_thousand_unknown_messages_a_second(flying: Flying) -> None:
    flying.until_sending()
    began_ns, rng = time.monotonic_ns(), random.Random(3)
    n_sent = 0
    while (passed_s := (time.monotonic_ns() - began_ns) * 1e-9) < LASTS_S:
        while n_sent < 1000 * passed_s:
            number = (55_000 + n_sent % 50).to_bytes(3, "little")
            head = bytes([0xFD, 8, 0, 0, n_sent % 256, 1, 1]) + number
            flying.autopilot.send_bytes(head + rng.randbytes(10))
            n_sent += 1
        time.sleep(0.005)
    print(f"{n_sent} in {LASTS_S} s")
    flying.assert_went_on(began_ns)
    assert flying.until_source("autopilot", "running")
    assert flying.daemon.status()["loop_delay_p99_ms"] is not None
    flying.assert_true_poses()


def test_the_machines_clock_is_set_an_hour_ahead(flying: Flying, clock_set: Path) -> None:
    flying.until_sending()
    uptime_s = flying.daemon.status()["uptime_s"]
    set_ns = time.monotonic_ns()
    clock_set.touch()
    try:
        time.sleep(1.5)
        assert flying.daemon.status()["uptime_s"] < uptime_s + 60
        flying.assert_went_on(set_ns)
        poses = flying.poses
        gaps_us = np.diff(poses.stamp_us[poses.came_s > set_ns * 1e-9])
        assert 0 < gaps_us.min() and gaps_us.max() < 10_000_000
        flying.assert_true_poses()
    finally:
        clock_set.unlink()


def test_the_autopilots_idea_of_the_date_jumps(flying: Flying) -> None:
    """What its GPS says of the date has no say in what its boot time is."""
    flying.until_sending()
    began_ns = time.monotonic_ns()
    for hours in (1, -1, 0):
        for _ in range(10):
            boot_ms = flying.autopilot.boot_ns() // 10**6
            unix_us = time.time_ns() // 1000 + hours * 3_600_000_000
            flying.autopilot.send(mavlink.MAVLink_system_time_message(unix_us, boot_ms))
            time.sleep(0.03)
    flying.assert_went_on(began_ns)
    flying.assert_true_poses()


def test_unplugged_and_back(flying: Flying) -> None:
    flying.until_sending()
    pulled_ns = time.monotonic_ns()
    flying.autopilot.unplug()
    try:
        flying.daemon.line("autopilot silent", after_ns=pulled_ns)
        assert "flight_controller" in flying.until_source("autopilot", "silent")["detail"]
    finally:
        flying.autopilot.plug()
    plugged_ns = time.monotonic_ns()
    flying.until_source("autopilot", "running")
    flying.assert_soon(plugged_ns, time.monotonic_ns())
    flying.assert_resumed(plugged_ns)
    flying.assert_true_poses()


def test_it_still_ends_in_time(flying: Flying) -> None:
    flying.assert_stops()
    assert not flying.daemon.said("Traceback")
