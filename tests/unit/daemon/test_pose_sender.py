"""Poses sent over boots of the autopilot and restarts of ours: heights, reset counters, disks."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Callable, Coroutine
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import FeedbackConfig
from companion.daemon.pose import kept_counter
from companion.daemon.pose.kept_counter import counter_path
from companion.daemon.pose.pose_sender import PoseSender
from companion.geometry.transforms import Pose
from companion.messages import Odometry, TrackState, Warned
from companion.products.atomic_file import write_atomically
from companion.telemetry import AttitudeSample, Telemetry
from tests.support.autopilot.memory_link import SetClock, listen, memory_link
from tests.support.autopilot.memory_port import MemoryPort

MS = 1_000_000
CAMERA_HZ = 20.0
DOWN_M = -3.0
"""Of the body in our world."""


class Vehicle:
    """An autopilot on a link without a wire, and the process that sends it poses."""

    def __init__(self, path: Path, mode: Any = "odometry") -> None:
        self.path, self.mode = path, mode
        self.clock, self.port = SetClock(), MemoryPort()
        self.armed, self.boot_ns = True, self.clock.t_ns - 60 * 10**9
        self.down_m: float | None = -7.5
        """What LOCAL_POSITION_NED says; None: it is not sent."""
        self.above_home_m: float | None = None
        self.landed_state: int | None = None
        self.climb_m_s = 0.0
        self.warned: list[Warned] = []
        self.seq = 0
        self.other: int | None = None
        """Mark in the heartbeat of another companion; None: there is none."""
        self.line_bytes_per_s: float | None = None
        self.joins = True
        """Whether disks are as fast as they should be."""

    async def begin(self) -> None:
        """Start a process of ours: one that was killed leaves nothing behind but its files."""
        self.port = MemoryPort()
        self.port.capacity_bytes_per_s = self.line_bytes_per_s
        self.link = memory_link(self.port, self.clock, self._deliver, self.warned.append)
        self.sender = PoseSender(
            FeedbackConfig(mode=self.mode),
            CAMERA_HZ,
            self.link,
            self.clock,
            self.path,
            self.warned.append,
            lambda step: None,
        )
        await listen(self.link)
        self._reset_counter = 0

    def _deliver(self, sample: Telemetry) -> None:
        if isinstance(sample, AttitudeSample):
            self.sender.take_attitude(sample)

    def reboot(self, silent_s: int = 20) -> None:
        """Switched on anew, and heard again after a while."""
        self.boot_ns = self.clock.t_ns
        self.clock.t_ns += silent_s * 10**9

    def run(
        self, seconds: float, frames: bool = True, resets: int = 0, blind: bool = False
    ) -> list[Any]:
        """Go on for a while; the poses that were sent. Blind: by inertial dead reckoning."""
        n_before = len(self.poses)
        for _ in range(round(seconds * 200)):
            self.clock.t_ns += 5 * MS
            now_ns = self.clock.t_ns
            boot_ms = (now_ns - self.boot_ns) // MS
            if now_ns % (20 * MS) == 0:
                self._say(mavlink.MAVLink_attitude_message(boot_ms, 0, 0, 0, 0, 0, 0))
            if now_ns % (100 * MS) == 0:
                self._say_slow(boot_ms)
            if frames and now_ns % int(1e9 / CAMERA_HZ) == 0:
                self.seq += 1
                odometry = self._odometry(now_ns - 40 * MS, resets)
                if blind:
                    odometry = replace(
                        odometry, state=TrackState.DEAD_RECKONING, quality=1, inertial=True
                    )
                self.sender.take(odometry)
            self.sender.step()
            for thread in threading.enumerate() if self.joins else ():
                if thread.name == "reset counter":
                    thread.join()
        return self.poses[n_before:]

    def _odometry(self, t_ns: int, resets: int) -> Odometry:
        return Odometry(
            self.seq, t_ns, TrackState.TRACKING, resets, 80,
            Pose(np.eye(3), np.array([1.0, 2.0, DOWN_M])), np.zeros(3), 0.1, 0.2, 0.01,
        )  # fmt: skip

    def _say_slow(self, boot_ms: int) -> None:
        armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0
        self._say(mavlink.MAVLink_heartbeat_message(2, 3, armed, 0, 4, 3))
        if self.other is not None:
            self._say(mavlink.MAVLink_heartbeat_message(18, 8, 0, self.other, 4, 3), 197)
        if self.down_m is not None:
            self._say(
                mavlink.MAVLink_local_position_ned_message(boot_ms, 0, 0, self.down_m, 0, 0, 0)
            )
        if self.above_home_m is not None:
            above_mm = round(1e3 * self.above_home_m)
            self._say(mavlink.MAVLink_global_position_int_message(
                boot_ms, 0, 0, 0, above_mm, 0, 0, round(-100 * self.climb_m_s), 65535
            ))  # fmt: skip
        if self.landed_state is not None:
            self._say(mavlink.MAVLink_extended_sys_state_message(0, self.landed_state))

    def _say(self, message: Any, component: int = 1) -> None:
        self.port.hear(message, self.clock.t_ns + 2 * MS, component=component)

    @property
    def poses(self) -> list[Any]:
        kind = "ODOMETRY" if self.mode == "odometry" else "VISION_POSITION_ESTIMATE"
        return self.port.of(kind)

    @property
    def texts(self) -> list[str]:
        return [each.text for each in self.port.of("STATUSTEXT")]

    @property
    def why_not(self) -> str:
        return self.sender.health().why_not

    @property
    def not_kept(self) -> list[Warned]:
        return [each for each in self.warned if each.what == "reset counter is not kept"]


def flown(fly: Callable[[Path], Coroutine[Any, Any, None]]) -> Callable[[Path], None]:
    def test(tmp_path: Path) -> None:
        asyncio.run(fly(tmp_path))

    test.__name__, test.__doc__ = fly.__name__, fly.__doc__
    return test


@pytest.mark.parametrize("mode", ["odometry", "vision_position"])
async def test_the_first_counter_is_0_and_each_start_in_the_air_one_more(
    tmp_path: Path, mode: str
) -> None:
    vehicle = Vehicle(tmp_path / "kept.json", mode)
    for start in range(3):
        await vehicle.begin()
        poses = vehicle.run(4)
        assert {pose.reset_counter for pose in poses} == {start}
        if mode == "vision_position":
            speeds = vehicle.port.of("VISION_SPEED_ESTIMATE")
            assert {each.reset_counter for each in speeds} == {start}
    vehicle.sender.restart()
    assert {pose.reset_counter for pose in vehicle.run(3)} == {3}
    assert {pose.reset_counter for pose in vehicle.run(3, resets=1)[5:]} == {4}


@flown
async def test_what_is_on_the_disk_is_never_behind_what_was_sent(tmp_path: Path) -> None:
    path = tmp_path / "kept.json"
    vehicle = Vehicle(path)
    await vehicle.begin()
    send = vehicle.port.send

    def checked(message: Any) -> None:
        if message.get_type() == "ODOMETRY":
            assert json.loads(path.read_text())["reset_counter"] == message.reset_counter
        send(message)

    vehicle.port.send = checked  # type: ignore[method-assign, assignment]
    assert vehicle.run(3) and vehicle.run(3, resets=1) and vehicle.run(3, resets=2)
    assert vehicle.poses[-1].reset_counter == 2


@flown
async def test_an_autopilot_that_is_switched_on_anew_begins_at_0(tmp_path: Path) -> None:
    vehicle = Vehicle(tmp_path / "kept.json")
    await vehicle.begin()
    vehicle.run(4)
    vehicle.sender.restart()
    assert vehicle.run(4)[-1].reset_counter == 1
    vehicle.reboot()
    vehicle.down_m = -0.5
    poses = vehicle.run(6)
    rebooted = [pose for pose in poses if pose.reset_counter == 0]
    assert rebooted and rebooted[-1].z == -0.5
    assert [pose.reset_counter for pose in poses[-len(rebooted) :]] == [0] * len(rebooted)
    # and where it did so while no process of ours was there to hear it
    vehicle.reboot(silent_s=120)
    await vehicle.begin()
    assert {pose.reset_counter for pose in vehicle.run(4)} == {0}


@flown
async def test_a_process_that_is_started_anew_begins_at_the_height_of_then(tmp_path: Path) -> None:
    vehicle = Vehicle(tmp_path / "kept.json")
    await vehicle.begin()
    first = vehicle.run(4)
    vehicle.down_m = -20.0
    assert {pose.z for pose in [*first, *vehicle.run(2)]} == {-7.5}
    await vehicle.begin()
    assert {pose.z for pose in vehicle.run(4)} == {-20.0}


@flown
async def test_nothing_begins_in_the_air_without_a_height(tmp_path: Path) -> None:
    vehicle = Vehicle(tmp_path / "kept.json")
    vehicle.down_m = None
    await vehicle.begin()
    assert not vehicle.run(4) and vehicle.why_not == "no autopilot height"
    vehicle.down_m = float("nan")
    assert not vehicle.run(2)
    vehicle.down_m = -4.0
    assert vehicle.run(1)[0].z == -4.0


@flown
async def test_poses_begin_at_the_height_of_an_autopilot_whose_position_is_not_believed(
    tmp_path: Path,
) -> None:
    """It is where the receiver counts from: by any other number the vehicle would climb or fall."""
    vehicle = Vehicle(tmp_path / "kept.json")
    await vehicle.begin()
    vehicle.sender.begin_flight(("attitude", "imu"))
    assert {pose.z for pose in vehicle.run(4)} == {-7.5}


@flown
async def test_nothing_is_sent_where_the_attitude_is_not_believed(tmp_path: Path) -> None:
    vehicle = Vehicle(tmp_path / "kept.json")
    await vehicle.begin()
    vehicle.sender.begin_flight(("imu", "position", "satellites"))
    assert not vehicle.run(4) and vehicle.why_not == "attitude is not believed"


@pytest.mark.parametrize(("armed", "landed_state"), [(False, None), (True, 1)])
async def test_on_the_ground_poses_begin_at_0(
    tmp_path: Path, armed: bool, landed_state: int | None
) -> None:
    vehicle = Vehicle(tmp_path / "kept.json")
    vehicle.down_m, vehicle.armed, vehicle.landed_state = None, armed, landed_state
    await vehicle.begin()
    assert {pose.z for pose in vehicle.run(4)} == {0.0}


@flown
async def test_a_copter_that_tells_no_local_position_yet_tells_its_climb(tmp_path: Path) -> None:
    """ArduCopter without satellites: home may lie anywhere, and is where it took off."""
    vehicle = Vehicle(tmp_path / "kept.json")
    vehicle.down_m, vehicle.armed, vehicle.above_home_m = None, False, 584.1
    await vehicle.begin()
    vehicle.run(2, frames=False)
    vehicle.armed, vehicle.above_home_m = True, 589.1
    assert {round(pose.z, 3) for pose in vehicle.run(4)} == {-5.0}
    vehicle.above_home_m = 590.1
    await vehicle.begin()
    assert {round(pose.z, 3) for pose in vehicle.run(4)} == {-6.0}, "home was kept with the counter"


@flown
async def test_a_landed_state_of_a_second_ago_does_not_move_home(tmp_path: Path) -> None:
    """It is told once a second, and a copter that lifts off climbs meanwhile."""
    vehicle = Vehicle(tmp_path / "kept.json")
    vehicle.down_m, vehicle.armed, vehicle.above_home_m = None, False, 584.1
    vehicle.landed_state = 1
    await vehicle.begin()
    vehicle.run(2, frames=False)
    vehicle.armed, vehicle.above_home_m, vehicle.climb_m_s = True, 584.8, 1.0
    vehicle.run(1, frames=False)
    vehicle.landed_state = 2
    vehicle.run(1, frames=False)
    vehicle.above_home_m, vehicle.climb_m_s = 589.1, 0.0
    assert {round(pose.z, 3) for pose in vehicle.run(4)} == {-5.0}


@flown
async def test_a_disk_that_cannot_be_written_is_reported_once(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    vehicle, counters = Vehicle(tmp_path / "file" / "kept.json"), []
    for _ in range(2):
        await vehicle.begin()
        vehicle.warned.clear()
        poses = vehicle.run(4)
        counters.append(poses[0].reset_counter)
        assert {pose.reset_counter for pose in poses} == {counters[-1]}
        assert {p.reset_counter for p in vehicle.run(3, resets=1)[5:]} == {counters[-1] + 1}
        assert len(vehicle.not_kept) == 1
    assert 0 not in counters and len(set(counters)) == 2


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"boot": 3}', bytes(range(256))])
async def test_a_damaged_file_is_not_taken_for_none(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "kept.json"
    path.write_bytes(content)
    vehicle = Vehicle(path)
    await vehicle.begin()
    poses = vehicle.run(4)
    assert poses and 0 not in {pose.reset_counter for pose in poses}
    assert len(vehicle.not_kept) == 1
    await vehicle.begin()
    assert vehicle.run(4)[0].reset_counter == poses[0].reset_counter + 1, "it was put right"


@flown
async def test_a_disk_that_hangs_stalls_no_pose(tmp_path: Path) -> None:
    vehicle, hangs = Vehicle(tmp_path / "kept.json"), threading.Event()
    write = write_atomically

    def hanging(path: Path, data: bytes, durable: bool = False) -> None:
        hangs.wait(60)
        write(path, data, durable)

    vehicle.joins = False
    patch = pytest.MonkeyPatch()
    patch.setattr(kept_counter, "write_atomically", hanging)
    try:
        await vehicle.begin()
        vehicle.run(2.4)
        poses = vehicle.run(2)
        assert len(poses) > 50 and len(vehicle.not_kept) == 1
        assert poses[-1].reset_counter != 0
        stamps_ms = np.diff([pose.time_usec for pose in vehicle.poses]) * 1e-3
        assert stamps_ms.max() < 60
    finally:
        hangs.set()
        patch.undo()
        for thread in threading.enumerate():
            if thread.name == "reset counter":
                thread.join()


def test_the_counter_lies_where_the_service_keeps_its_state() -> None:
    assert counter_path("flights", {}) == Path("sent_poses.json")
    assert counter_path("/data/flights", {}) == Path("/data/sent_poses.json")
    state = {"STATE_DIRECTORY": "/var/lib/companion:/other"}
    assert counter_path("/data/flights", state) == Path("/var/lib/companion/sent_poses.json")


@flown
async def test_the_pilot_hears_of_dead_reckoning_that_lasts(tmp_path: Path) -> None:
    vehicle = Vehicle(tmp_path / "kept.json")
    await vehicle.begin()
    vehicle.run(4)
    assert vehicle.run(0.8, blind=True)
    vehicle.run(1)
    assert vehicle.texts == ["Companion: vision position on"]
    assert vehicle.run(2, blind=True)
    assert vehicle.sender.health().bridging
    assert vehicle.texts[1:] == ["Companion: position by dead reckoning"]
    vehicle.run(1)
    assert not vehicle.sender.health().bridging
    assert vehicle.texts[2:] == ["Companion: vision position on"]
    vehicle.run(2, blind=True)
    vehicle.run(1, frames=False)
    assert vehicle.texts[3:] == [
        "Companion: position by dead reckoning", "Companion: vision position lost: no video"
    ]  # fmt: skip


@flown
async def test_nothing_begins_beside_another_companion(tmp_path: Path) -> None:
    vehicle = Vehicle(tmp_path / "kept.json")
    await vehicle.begin()
    vehicle.armed, vehicle.other = False, 4711
    assert not vehicle.run(35)
    assert vehicle.why_not == "another companion on the link"
    assert [each.what for each in vehicle.warned].count("another companion on the link") == 1
    assert vehicle.texts == ["Companion: no vision position: second companion"]
    vehicle.armed, vehicle.other = True, None  # gone in the air, where its poses were flown on
    assert not vehicle.run(10)
    vehicle.armed = False
    assert vehicle.run(5)


@flown
async def test_nothing_begins_on_a_line_that_is_too_slow(tmp_path: Path) -> None:
    vehicle = Vehicle(tmp_path / "kept.json")
    vehicle.line_bytes_per_s = 10800.0  # 40 poses of 245 bytes a second, and 700 beside
    await vehicle.begin()
    assert not vehicle.run(35)
    assert vehicle.why_not == "the link is too slow"
    assert vehicle.texts == ["Companion: no vision position: link too slow"]
    vehicle.line_bytes_per_s = 11520.0
    await vehicle.begin()
    assert vehicle.run(5)


@flown
async def test_who_sends_already_goes_on_beside_another_companion(tmp_path: Path) -> None:
    vehicle = Vehicle(tmp_path / "kept.json")
    await vehicle.begin()
    vehicle.armed = False
    vehicle.run(4)
    vehicle.other = vehicle.link.other_companion.mark  # an echo of our own heartbeat
    vehicle.run(2)
    assert [each.what for each in vehicle.warned] == ["autopilot found"]
    vehicle.other = 4711
    assert len(vehicle.run(2)) > 30
    vehicle.run(1, frames=False)
    vehicle.armed = True
    assert len(vehicle.run(4)) > 30
    vehicle.other = 0  # one whose feedback is off
    assert len(vehicle.run(2)) > 30


@flown
async def test_the_pilot_hears_why_there_is_no_pose_for_long(tmp_path: Path) -> None:
    vehicle = Vehicle(tmp_path / "kept.json")
    await vehicle.begin()
    vehicle.down_m = None
    vehicle.run(29)
    assert not vehicle.texts
    vehicle.run(70)
    assert vehicle.texts == ["Companion: no vision position: no height"] * 2
    vehicle.down_m = -7.5
    vehicle.run(3)
    assert vehicle.texts[2:] == ["Companion: vision position on"]
