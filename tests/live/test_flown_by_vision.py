"""A drone without GPS that flies by our poses alone: it stands, flies a square, loses its cable."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest

from companion.geometry.transforms import Array
from tests.support.autopilot.fake_wire import free_port
from tests.support.autopilot.flying_vehicle import FlownByVision, Moment
from tests.support.cameras.http_camera import HttpCamera
from tests.support.processes.daemon_process import Daemon
from tests.support.processes.strain import Strain

HEIGHT_M, SIDE_M = 7.0, 4.0
HEIGHT_OF = {"ardupilot": "GLOBAL_POSITION_INT", "px4": "LOCAL_POSITION_NED"}
"""What tells its height before it has a position."""
CORNERS = ((SIDE_M, 0.0), (SIDE_M, SIDE_M), (0.0, SIDE_M), (0.0, 0.0))

FIRST_POSE_S, AGAIN_S = 15.0, 2.5
WITHOUT_POSE_S, CLIMB_M_S = 8.0, 2.0
"""A pilot who has no pose after so long climbs on, as he is told to."""
BACK_S, THERE_M = 5.0, 0.2
"""So long it may take to go back to where it believes itself to be, within so much."""


@dataclass
class Flown:
    """What truly happened. Lists of moments cover what is said, from its begin to its end."""

    first_pose_s: float = 0.0
    """After take-off,"""
    first_allowed_s: float = 0.0
    """and the time that this machine is given for it."""
    begun: list[Moment] = field(default_factory=list)
    """From just before that pose."""
    standing: list[Moment] = field(default_factory=list)
    corners: list[Moment] = field(default_factory=list)
    before_pull: Array = field(default_factory=lambda: np.zeros(3))
    back_again: list[Moment] = field(default_factory=list)
    without_pose_s: float = 0.0
    again_s: float = 0.0
    """From the cable's return to the next pose,"""
    again_allowed_s: float = 0.0
    """and the time that this machine is given for it."""
    n_refused: int = 0
    texts: list[str] = field(default_factory=list)


def is_there(moment: Moment) -> bool:
    """Whether it believes to be where it is to be."""
    return bool(np.linalg.norm((moment.believed - moment.wanted)[:2]) < THERE_M)


@pytest.fixture(scope="module", params=["ardupilot", "px4"])
def flown(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Flown]:
    folder, out, udp_port = tmp_path_factory.mktemp("square"), Flown(), free_port()
    drone = FlownByVision(request.param, f"udpout:127.0.0.1:{udp_port}")
    if request.param == "ardupilot":
        drone.parameters["VISO_DELAY_MS"] = 40
    camera = HttpCamera(640, 480, world_from_body=drone.world_from_body)
    calibration = camera.write_calibration(folder / "camera.json")
    settings = (
        "camera.source=network", f"camera.url={camera.url}", "camera.width=640",
        "camera.height=480", f"camera.calibration={calibration}", "depth.enabled=false",
        f"link.url=udpin:127.0.0.1:{udp_port}", "feedback.mode=odometry",
    )  # fmt: skip

    def during(seconds: float) -> list[Moment]:
        n_before = len(drone.moments)
        time.sleep(seconds)
        return drone.moments[n_before:]

    with Strain() as strain, camera, drone, Daemon(folder, *settings) as daemon:
        daemon.until(lambda health: {each["state"] for each in health["sources"]} == {"running"})
        while drone.rates_hz.get(HEIGHT_OF[request.param], 0.0) < 5:
            time.sleep(0.05)
        during(1.0)  # it tells its height on the ground
        begun_s = time.monotonic()
        drone.take_off(HEIGHT_M)
        while not drone.knows_its_place:
            waited_s = time.monotonic() - begun_s
            assert waited_s < 40, "no pose"
            # where a busy machine begins its map late, half of the climb is no scale yet
            drone.go_to(0.0, 0.0, HEIGHT_M + CLIMB_M_S * max(0.0, waited_s - WITHOUT_POSE_S))
            time.sleep(0.05)
        out.first_pose_s = time.monotonic() - begun_s
        out.first_allowed_s = strain.allowed_s(FIRST_POSE_S, round(begun_s * 1e9))
        n_before = len(drone.moments) - 50
        during(4.0)
        out.begun = drone.moments[n_before:]
        out.standing = during(5.0)
        for corner in CORNERS:
            drone.go_to(*corner)
            out.corners.append(during(5.0)[-1])
        out.before_pull = drone.moments[-1].place
        drone.unplug()
        pulled_s = time.monotonic()
        during(2.5)
        drone.plug()
        plugged_s = time.monotonic()
        while not drone.knows_its_place:
            assert time.monotonic() - plugged_s < 20, "no pose again"
            time.sleep(0.02)
        out.again_s = time.monotonic() - plugged_s
        out.again_allowed_s = strain.allowed_s(AGAIN_S, round(plugged_s * 1e9))
        out.without_pose_s = time.monotonic() - pulled_s
        until_s = time.monotonic() + BACK_S
        while not is_there(drone.moments[-1]) and time.monotonic() < until_s:
            time.sleep(0.05)
        out.back_again = during(2.0)
        out.n_refused, out.texts = drone.n_refused, drone.texts()
        daemon.stop()
    yield out


def test_its_height_does_not_jump_when_poses_begin(flown: Flown) -> None:
    """What it holds is the height that it had, though the map began somewhere on the way up."""
    down_m = np.array([each.believed[2] - each.place[2] for each in flown.begun])
    jump_m = float(np.ptp(down_m))
    print(f"believed height moved by {jump_m:.2f} m against the true one")
    assert jump_m < 0.4


def test_it_stands(flown: Flown) -> None:
    print(f"{flown.first_pose_s:.1f} s to the first pose, of {flown.first_allowed_s:.1f} s")
    assert flown.first_pose_s < flown.first_allowed_s
    place = np.array([each.place for each in flown.standing])
    # a machine that is busy elsewhere may be late with a few pictures
    assert np.mean([each.has_pose for each in flown.standing]) > 0.8
    away_m = np.linalg.norm((place - place.mean(0))[:, :2], axis=1)
    print(f"{away_m.max():.2f} m away at most")
    assert away_m.max() < 0.7


def test_it_flies_a_square(flown: Flown) -> None:
    """Its sides are as long as they were meant to be, and it ends where it began."""
    stood = np.mean([each.place for each in flown.standing], axis=0)
    for wanted, got in zip(CORNERS, flown.corners, strict=True):
        error_m = float(np.linalg.norm((got.place - stood)[:2] - wanted))
        print(f"{wanted}: {error_m:.2f} m away")
        assert error_m < 0.8
    assert flown.n_refused == 0


def test_it_comes_back_when_its_cable_was_pulled(flown: Flown) -> None:
    assert flown.without_pose_s > 2.0
    away_m = float(np.linalg.norm((flown.back_again[-1].place - flown.before_pull)[:2]))
    print(f"a pose again after {flown.again_s:.2f} s; {away_m:.2f} m away")
    assert flown.again_s < flown.again_allowed_s
    assert away_m < 0.8
    assert "Companion: vision position on" in flown.texts
