"""A ground station at the router's port has the companion do what docs/control.md says."""

from __future__ import annotations

import json
import random
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.daemon.control.flight_parameters import PARAMETERS
from companion.daemon.control.ground_control import BUDGET, MAPPING, NEW_MAP, SNAPSHOT
from companion.geometry.geodesy import ned_from_geodetic
from tests.support.autopilot.fake_wire import free_port
from tests.support.autopilot.ground_station import OURS, GroundStation
from tests.support.cameras.http_camera import world_from_body
from tests.support.processes.daemon_process import UNGOVERNED
from tests.support.processes.flying import MOST_AWAY_M, Flying
from tests.support.reference.scoring import read_ply

ACCEPTED, DENIED = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_DENIED
FAILED, IN_PROGRESS = mavlink.MAV_RESULT_FAILED, mavlink.MAV_RESULT_IN_PROGRESS
UNSUPPORTED = mavlink.MAV_RESULT_UNSUPPORTED
REQUEST_MESSAGE, SET_INTERVAL = (
    mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
)  # fmt: skip
MAP_S = 120.0
"""A first piece of the dense map on a processor that others use too."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("ground")


@pytest.fixture(scope="module")
def port() -> int:
    return free_port(socket.SOCK_STREAM)


@pytest.fixture(scope="module")
def flying(folder: Path, port: int) -> Iterator[Flying]:
    """In the dark at first, so that there is no map."""
    settings = (
        f'router.clients=["tcpin:127.0.0.1:{port}"]',
        f"stream.listen=127.0.0.1:{free_port(socket.SOCK_STREAM)}",
        f"expert.control.keep={folder}/kept.toml", "depth.enabled=true", "expert.depth.stride=8",
        "expert.feedback.min_quality=15", "expert.features.n_features=500",
    )  # fmt: skip
    dark = Flying(folder, *settings, program=UNGOVERNED)
    dark.camera.covered = True
    with dark as begun:
        begun.until_source("camera", "running")
        begun.until_source("autopilot", "running")
        yield begun


@pytest.fixture
def ground(flying: Flying, port: int) -> Iterator[GroundStation]:
    with GroundStation(port) as connected:
        connected.heard("HEARTBEAT")
        yield connected


def snapshots(flying: Flying) -> list[Path]:
    """Clouds that were written in flight, in order of their numbers."""
    (flight,) = flying.daemon.flown()
    return sorted(flight.glob("snapshot-*.ply"))


def test_before_take_off(flying: Flying, ground: GroundStation) -> None:
    standby = mavlink.MAV_STATE_STANDBY
    ground.heard("HEARTBEAT", lambda beat: beat.system_status == standby)
    found = ground.parameters()
    assert list(found) == list(PARAMETERS)
    assert (found["FB_MODE"], found["FB_MIN_QUALITY"], found["MAP_STRIDE"]) == (1.0, 15.0, 8.0)
    assert ground.set("FB_MIN_QUALITY", 20.0) == 20.0
    health = flying.daemon.until(
        lambda health: health["set_by_ground"] == {"expert.feedback.min_quality": 20}, "set"
    )
    assert health["feedback"]["mode"] == "odometry"
    table = subprocess.run(
        [sys.executable, "-m", "companion", "status",
         "--set", f"expert.daemon.socket={flying.daemon.socket}"],
        capture_output=True, text=True, check=True, timeout=30,
    ).stdout  # fmt: skip
    assert "expert.feedback.min_quality = 20 (by the ground)" in table
    flying.daemon.line("ground: expert.feedback.min_quality = 20")
    kept = flying.daemon.folder / "kept.toml"
    flying.daemon.until(lambda _: kept.exists() and "min_quality = 20" in kept.read_text(), "kept")
    assert ground.set("FB_MIN_QUALITY", 1000.0) == 20.0
    flying.until_stage("results", lambda found: found["detail"] != "starting")
    assert ground.command(SNAPSHOT) == [IN_PROGRESS, FAILED]
    flying.daemon.line("no cloud was written: ")
    assert not snapshots(flying)
    flying.camera.heal()


def test_what_ground_stations_ask_of_every_component(ground: GroundStation) -> None:
    assert ground.command(REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION) == [ACCEPTED]
    version = ground.heard("AUTOPILOT_VERSION")
    assert version.capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    assert ground.command(mavlink.MAV_CMD_REQUEST_PROTOCOL_VERSION, 1.0) == [ACCEPTED]
    assert ground.command(REQUEST_MESSAGE, 259.0) == [UNSUPPORTED]  # of a camera
    assert ground.command(REQUEST_MESSAGE, float("nan")) == [DENIED]
    assert ground.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0) == [UNSUPPORTED]
    status = mavlink.MAVLINK_MSG_ID_ONBOARD_COMPUTER_STATUS
    assert ground.command(SET_INTERVAL, status, 200_000.0) == [ACCEPTED]
    assert ground.command(REQUEST_MESSAGE, 244.0, status) == [ACCEPTED]
    assert ground.heard("MESSAGE_INTERVAL").interval_us == 200_000
    assert ground.command(SET_INTERVAL, status, 1000.0) == [DENIED]
    assert ground.command(SET_INTERVAL, status, 0.0) == [ACCEPTED]


def test_mapping_is_left_and_taken_up(flying: Flying, ground: GroundStation) -> None:
    flying.take_off()
    flying.until_stage("depth", lambda found: found["n"] > 0, MAP_S)
    assert ground.command(MAPPING, 0.0) == [ACCEPTED]
    flying.until_stage("depth", lambda found: found["detail"] == "switched off")
    until_s = time.monotonic() + MAP_S
    n_before, n_done = -1, 0
    while n_done > n_before:  # it works off what waits, with the time that is left over
        assert time.monotonic() < until_s, "it goes on"
        n_before = flying.until_stage("depth", lambda found: True)["n"]
        time.sleep(2.0)  # the status is of every second
        n_done = flying.until_stage("depth", lambda found: True)["n"]
    assert ground.command(MAPPING, 1.0) == [ACCEPTED]
    flying.until_stage("depth", lambda found: found["n"] > n_done + 5, MAP_S)
    assert ground.command(MAPPING, 0.5) == [DENIED]


def test_the_cloud_is_written_now(flying: Flying, ground: GroundStation) -> None:
    until_s = time.monotonic() + MAP_S
    while (results := ground.command(SNAPSHOT)) == [IN_PROGRESS, FAILED]:  # no points yet
        assert time.monotonic() < until_s
        time.sleep(1.0)
    assert results == [IN_PROGRESS, ACCEPTED]
    path = snapshots(flying)[-1]
    n_points = len(read_ply(path))
    assert n_points
    flying.daemon.line(f"cloud written: {path.name}, {n_points} points")


def test_viewers_have_a_budget(flying: Flying, ground: GroundStation) -> None:
    assert ground.command(BUDGET, 300.0) == [ACCEPTED]
    flying.until_stage("viewers", lambda found: "budget 300 kbit/s" in found["detail"])
    assert ground.command(BUDGET, -5.0) == [DENIED]
    flying.daemon.until(
        lambda health: health["set_by_ground"].get("expert.stream.budget_kbit_s") == 300.0, "told"
    )


def test_while_armed_the_pose_cannot_be_made_easier(flying: Flying, ground: GroundStation) -> None:
    flying.take_off()
    began_ns = time.monotonic_ns()
    assert ground.set("FB_MIN_QUALITY", 5.0) == 20.0
    assert ground.set("FB_MODE", 2.0) == 1.0
    assert ground.set("FB_MIN_QUALITY", 21.0) == 21.0
    time.sleep(1.0)
    flying.assert_went_on(began_ns)  # a stricter limit takes no pose away that keeps it


def test_the_way_back_is_fetched(flying: Flying, ground: GroundStation) -> None:
    flying.take_off()
    until_s = time.monotonic() + MAP_S
    while len(found := ground.mission()) < 4:
        assert time.monotonic() < until_s
        time.sleep(1.0)
    now_ns, origin = time.monotonic_ns(), flying.autopilot.flight.origin
    way_m = np.stack([ned_from_geodetic(*place, origin) for place in found])
    flown_m = np.stack(
        [world_from_body(now_ns - n * 50_000_000).translation for n in range(int(MAP_S * 20))]
    )
    off_m = np.linalg.norm(way_m[:, None] - flown_m, axis=2)
    assert off_m.min(1).max() < MOST_AWAY_M
    assert off_m[1, : 20 * 5].min() < MOST_AWAY_M  # the first lies where it is
    np.testing.assert_array_equal(way_m[0], way_m[-1])  # ArduPilot's home
    flying.daemon.line("ground: way back: ")


def test_a_storm_of_requests_delays_no_pose(flying: Flying, port: int) -> None:
    """All kinds, for us, from one and from many; and what is no request at all."""
    flying.take_off()
    rng, codec, began_ns = random.Random(3), mavlink.MAVLink(None, 255, 190), time.monotonic_ns()
    messages = [
        mavlink.MAVLink_param_request_list_message(*OURS),
        mavlink.MAVLink_param_request_read_message(*OURS, b"FB_MODE", -1),
        mavlink.MAVLink_param_set_message(*OURS, b"FB_RATE_HZ", 1e9, 9),
        mavlink.MAVLink_command_long_message(*OURS, 512, 0, 148, 0, 0, 0, 0, 0, 0),
        mavlink.MAVLink_mission_request_list_message(*OURS),
        mavlink.MAVLink_mission_count_message(*OURS, 60_000),
        mavlink.MAVLink_command_long_message(*OURS, 7777, 0, 1, 0, 0, 0, 0, 0, 0),
    ]
    with GroundStation(port) as ground:
        ground._socket.setblocking(False)
        while time.monotonic_ns() - began_ns < 3e9:
            codec.srcSystem = rng.choice((255, 254, rng.randrange(2, 255)))
            data = b"".join(rng.choice(messages).pack(codec) for _ in range(50))
            try:
                ground._socket.send(data + rng.randbytes(20))
                ground._socket.recv(1 << 16)
            except BlockingIOError:
                pass
            time.sleep(0.005)
    flying.assert_went_on(began_ns)
    flying.daemon.line("more is asked of the companion", after_ns=began_ns)


def test_a_new_map_raises_the_reset_counter(flying: Flying, ground: GroundStation) -> None:
    flying.autopilot.arm()
    before = flying.daemon.until(lambda health: health["quality"] > 0, "it finds its way")
    assert ground.command(NEW_MAP) == [DENIED]  # the autopilot may fly on these poses
    began_ns = time.monotonic_ns()
    assert ground.command(NEW_MAP, 1.0) == [IN_PROGRESS, ACCEPTED]
    n_resets = before["feedback"]["n_resets"] + 1
    flying.daemon.until(
        lambda health: health["flight"] not in ("", before["flight"])
        and health["feedback"]["n_resets"] == n_resets, "another flight, and that it was told",
    )  # fmt: skip
    flying.daemon.line("ground: a new map begins", after_ns=began_ns)
    flying.daemon.line("flight over", after_ns=began_ns)
    assert json.loads((flying.daemon.flights / before["flight"] / "report.json").read_text())
    flying.daemon.until(
        lambda _: all((path / "flight.mcap").exists() for path in flying.daemon.flown()), "recorded"
    )
    flying.until_sending(MAP_S)
    assert flying.poses.resets[-1] >= n_resets


def test_the_pose_is_switched_off(flying: Flying, ground: GroundStation) -> None:
    flying.take_off()
    began_ns = time.monotonic_ns()
    assert ground.set("FB_MODE", 0.0) == 0.0
    flying.assert_ceased(began_ns)
    flying.until_told("vision position off: ground command", began_ns)
    assert flying.daemon.status()["feedback"]["mode"] == "off"
    assert ground.set("FB_MODE", 1.0) == 0.0  # until it has landed
    flying.autopilot.disarm()
    flying.daemon.line("disarmed", after_ns=began_ns)
    assert ground.set("FB_MODE", 1.0) == 1.0
    assert not flying.daemon.said("Traceback")
    flying.assert_stops()
