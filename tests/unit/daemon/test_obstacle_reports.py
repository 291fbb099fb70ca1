"""Obstacles told before a wall and a pole of known depth, on a link without a wire."""

from __future__ import annotations

import asyncio
import sys
import threading
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from companion.app.replay.obstacles_again import ObstaclesAgain
from companion.config import Config, FeedbackConfig
from companion.daemon.obstacle_reports import UNKNOWN_AFTER_NS, ObstacleReports
from companion.flight_notes import GateStep, ObstaclePoints
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose, Similarity, rotation_from_vector
from companion.messages import (
    Bytes,
    DepthMap,
    Floats,
    Frame,
    Georeference,
    MapUpdate,
    ObstaclesSeen,
    PixelState,
    PointChunk,
    Track,
    TrackState,
)
from companion.obstacles.obstacle_finder import MAX_AGE_NS, MOST_TRACKS
from companion.obstacles.obstacle_sectors import FREE_M
from companion.obstacles.occupancy_grid import DOUBT, FADES_NS, MOST
from companion.pilot_messages import PilotText
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.vehicle import Firmware, Vehicle
from drivers.recording.decisions import Decisions, payloads_of, points_of, step_of
from drivers.recording.recording_codec import decision_bytes, obstacle_points_bytes
from tests.support.autopilot.memory_link import SetClock, memory_link
from tests.support.autopilot.memory_port import MemoryPort
from tests.unit.obstacles.test_newest_sight import SCENE

S = 1_000_000_000
FORWARD = Pose(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.zeros(3))
"""`body_from_camera` of a camera that looks ahead."""
CAMERA = Camera(160, 120, 110.0, 110.0, 79.5, 59.5, body_from_camera=FORWARD)
UNKNOWN, FREE = 65535, 2001
EYE = Camera(320, 290, 500.0, 500.0, 159.5, 144.5, body_from_camera=FORWARD)
"""Sees all heights that are searched, and the sectors from -3 to 3."""
METRES_PER_UNIT = 2.5
Pole = tuple[float, float, float]
"""North, east and radius, metres."""
PLACED = Georeference(
    Similarity(METRES_PER_UNIT, np.eye(3), np.array([0.0, 0.0, -10.0])), 0.01, 0.01, "", 9, 0.1
)


def depth_of(position_m: Array, wall_north_m: float, pole: Pole) -> Array:
    """z-depth (H, W), metres, of a wall across the north, and a pole (north, east, radius)."""
    x = np.tile((np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx, (CAMERA.height, 1))
    depth = np.full(x.shape, wall_north_m - position_m[0])
    north, east, radius = pole
    ahead = north - position_m[0]
    hit = np.abs(x * ahead - (east - position_m[1])) < radius
    return np.where(hit & (ahead > 0.2), np.minimum(ahead, depth), depth)


class Heard(ObstacleReports):
    """Reports that keep what comes, what is recorded, and what is sent."""

    def __init__(self, config: FeedbackConfig, link: AutopilotLink, clock: FlightClock) -> None:
        self.came: list[Any] = []
        self.steps: list[GateStep] = []
        self.points: list[ObstaclePoints] = []
        self.sent: list[Any] = []
        self.shown: list[ObstaclesSeen] = []
        super().__init__(config, link, clock, self._keep)

    def _keep(self, note: GateStep | ObstaclePoints | ObstaclesSeen) -> None:
        if isinstance(note, ObstaclesSeen):
            self.shown.append(note)
        elif isinstance(note, GateStep):
            self.steps.append(step_of(note.t_ns, decision_bytes(note)))
        else:
            self.points.append(points_of(note.t_ns, obstacle_points_bytes(note)))

    def take(self, message: Any) -> None:
        self.came.append(message)
        super().take(message)

    def frame(self, frame: Frame) -> None:
        self.came.append(frame)
        super().frame(frame)

    def told(self) -> list[Any]:
        """Messages of one round."""
        look = self.look()
        messages = self.tell(look, *look.found())
        self.sent += messages
        return messages

    def sent_again(self, camera: Camera) -> list[tuple[int, bytes]]:
        """Made again by what is recorded, of the same images and output of localisation."""
        told = Decisions(Config(), True, gates=self.steps, obstacle_points=self.points)
        again = ObstaclesAgain(told, camera)
        for message in self.came:
            if isinstance(message, Frame):
                again.frame(message)
            else:
                again.take(message)
        return again.payloads


class Approach:
    """North at 2 m/s towards a wall and a pole; a keyframe each 0.5 s, its depth 0.6 s later."""

    def __init__(self, wall_m: float = 12.0, pole: Pole = (9, 2, 0.1)) -> None:
        self.wall_m, self.pole = wall_m, pole
        self.clock, self.port = SetClock(), MemoryPort()
        self.began_ns = self.clock.t_ns
        self.link = memory_link(self.port, self.clock, lambda _: None)
        self.reports = Heard(FeedbackConfig(obstacle_distance=True), self.link, self.clock)
        self.reports.restart(CAMERA)
        self.keyframes: dict[int, Pose] = {}
        self.update: MapUpdate | None = None
        self.late: list[tuple[int, DepthMap]] = []
        self.position = np.zeros(3)
        across, down = np.meshgrid(np.linspace(2, 157, 40), np.linspace(20, 100, 8))
        self.keypoints_px: Floats | None = np.c_[across.ravel(), down.ravel()].astype(np.float32)
        """Of the map points found in each frame: all over the image, at first."""

    @property
    def map_from_camera(self) -> Pose:
        return Pose(FORWARD.rotation, self.position / METRES_PER_UNIT)

    def fly(self, seconds: float, speed_m_s: float = 2.0, tracked: bool = True) -> list[int]:
        """Distances of the last message, cm."""
        for _ in range(round(seconds * 20)):
            self.clock.t_ns += S // 20
            self.position = self.position + [speed_m_s / 20, 0, 0]
            now_ns = self.clock.t_ns
            since = round((now_ns - self.began_ns) / (S / 20))
            if tracked:
                self.reports.take(
                    Track(
                        since, now_ns - S // 20, TrackState.TRACKING, self.map_from_camera,
                        keypoints_px=self.keypoints_px,
                    )
                )  # fmt: skip
            if speed_m_s and tracked and since % 10 == 0:
                self.add_keyframe(since // 10, now_ns)
            while self.late and self.late[0][0] <= now_ns:
                self.reports.take(self.late.pop(0)[1])
        return self.now()

    def add_keyframe(self, keyframe_id: int, t_ns: int) -> None:
        self.keyframes[keyframe_id] = self.map_from_camera
        self.update = MapUpdate(1, t_ns, dict(self.keyframes), np.zeros((0, 3)), PLACED)
        self.reports.take(self.update)
        depth = (depth_of(self.position, self.wall_m, self.pole) / METRES_PER_UNIT).astype(
            np.float32
        )
        state = np.full(depth.shape, PixelState.CONVERGED.value, np.uint8)
        rgb = np.zeros((*depth.shape, 3), np.uint8)
        made = DepthMap(
            keyframe_id, t_ns, (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy), depth, 0.002 * depth,
            state, np.ones_like(depth), rgb, 7, {},
        )  # fmt: skip
        self.late.append((t_ns + round(0.6 * S), made))

    def now(self) -> list[int]:
        messages = self.reports.told()
        return list(messages[0].distances) if messages else []


def truth_cm(approach: Approach, sector: int) -> float:
    """Nearest in a sector, horizontally, whatever part of it is seen."""
    bearings = np.radians(
        5.0 * (sector - 72 if sector > 36 else sector) + np.linspace(-2.5, 2.5, 41)
    )
    ahead = approach.wall_m - approach.position[0]
    wall = ahead / np.cos(bearings)
    north, east = approach.pole[0] - approach.position[0], approach.pole[1]
    pole_bearing = np.arctan2(east, north)
    nearest = float(wall.min())
    if bearings[0] <= pole_bearing <= bearings[-1] and north > 0.3:
        nearest = min(nearest, float(np.hypot(north, east)))
    return 100 * nearest


IN_VIEW = [(sector % 72) for sector in range(-5, 6)]


def test_distances_on_the_way_to_a_wall_and_a_pole() -> None:
    """Within 5 % and 0.3 m, and none in view is called free: down to 3 m before the wall."""
    approach = Approach()
    approach.fly(1.5)
    n = off = 0
    while approach.position[0] < 9.0:
        found = approach.fly(0.1)
        for sector in IN_VIEW:
            truth = truth_cm(approach, sector)
            assert not (found[sector] == FREE and truth < 800)
            n += 1
            off += not abs(found[sector] - truth) <= 0.05 * truth + 30
    assert n > 300
    assert off / n < 0.05
    behind = {found[sector] for sector in range(20, 52)}
    assert behind == {UNKNOWN}


def test_an_obstacle_stays_for_a_while() -> None:
    stays_s = 1e-9 * FADES_NS * (MOST - DOUBT)
    approach = Approach(wall_m=45.0, pole=(15, 2.2, 0.1))
    assert 0 < approach.fly(3.0)[3] < 2000  # the pole
    assert 0 < approach.fly(stays_s - 3.0, 0.0)[3] < 2000
    assert set(approach.fly(5.0, 0.0)) == {UNKNOWN}


def test_a_sector_that_no_newest_frame_sees_is_unknown() -> None:
    """Though its obstacle stands where it was, and depth has told of it a second ago."""
    approach = Approach()
    assert FREE > approach.fly(3.0)[3]
    everywhere = approach.keypoints_px
    assert everywhere is not None
    approach.keypoints_px = everywhere[everywhere[:, 0] < CAMERA.cx]
    found = approach.fly(1e-9 * MAX_AGE_NS + 0.1)
    assert found[3] == UNKNOWN and found[69] != UNKNOWN
    approach.keypoints_px = None  # followed by its pattern, and none of its points found
    assert set(approach.fly(1e-9 * MAX_AGE_NS + 0.1)) == {UNKNOWN}


def test_points_of_the_map_in_the_newest_frame_are_obstacles() -> None:
    """As of something that no depth map shows yet."""
    approach = Approach(wall_m=60.0, pole=(0, 90, 0.1))
    approach.fly(1.5)
    assert approach.keypoints_px is not None
    post = np.c_[np.full(9, 8.0), np.full(9, -0.2), np.linspace(-0.5, 0.5, 9)]
    seen = CAMERA.project(FORWARD.inverse().apply(post - approach.position))
    approach.keypoints_px = np.concatenate([approach.keypoints_px, seen.astype(np.float32)])
    assert approach.update is not None
    approach.reports.take(replace(approach.update, points_map=post / METRES_PER_UNIT))
    found = approach.fly(0.05, speed_m_s=0.0)
    assert min(found[0], found[71]) == pytest.approx(100 * (8.0 - approach.position[0]), abs=30)


@cache
def picture(n: int) -> tuple[Pose, Bytes]:
    """Pose in the map and grey image of frame `n`: past a pole of 0.3 m, 6 m ahead."""
    pose = Pose(np.eye(3), np.array([0.0, 0.08 * n - 0.88, -3.0])) @ FORWARD
    return pose, SCENE.picture(EYE, pose)


def looked(
    firmware: Firmware, n_images: int = 12, in_space: bool = False
) -> tuple[list[Any], Heard]:
    """Told by images and poses alone, past a pole of 0.3 m, 6 m ahead, before a far wall."""
    clock: Any = SetClock()
    link = memory_link(MemoryPort(), clock, lambda _: None)
    link.vehicle = Vehicle(1, firmware, True, "")
    config = FeedbackConfig(obstacle_distance=True, obstacles_3d=in_space)
    reports = Heard(config, link, clock)
    reports.restart(EYE)
    keyframe = Pose(np.eye(3), np.array([0.0, 0.0, -3.0])) @ FORWARD
    world = Georeference(Similarity.identity(), 0.01, 0.01, "", 9, 0.1)
    reports.take(MapUpdate(1, clock.t_ns, {7: keyframe}, np.zeros((0, 3)), world))
    messages: list[Any] = []
    for n in range(n_images):
        pose, grey = picture(n)
        reports.frame(Frame(n, clock.t_ns, grey, np.repeat(grey[..., None], 3, 2)))
        relative = keyframe.inverse() @ pose
        reports.take(Track(n, clock.t_ns, TrackState.TRACKING, pose, 7, relative))
        clock.t_ns += S // 10
        messages = reports.told()
    return messages, reports


def test_images_alone_tell_of_a_pole_and_of_free_space() -> None:
    """To PX4 what is free is told, up to where it is; to ArduPilot, which does not ask, what stands
    farther away."""
    (message,), _ = looked("px4")
    distances = list(message.distances)
    assert min(distances[1], distances[2]) == pytest.approx(100 * np.hypot(6.0, 0.8), abs=60)
    assert distances[70] == distances[71] == round(100 * FREE_M) + 1
    assert set(distances[5:68]) == {UNKNOWN}
    (message,), reports = looked("ardupilot")
    distances = list(message.distances)
    assert min(distances[1], distances[2]) == pytest.approx(100 * np.hypot(6.0, 0.8), abs=60)
    assert distances[70] == distances[71] == UNKNOWN
    reports._clock.t_ns += MAX_AGE_NS  # type: ignore[attr-defined]
    (message,) = reports.told()
    assert set(message.distances) == {UNKNOWN}


@pytest.mark.parametrize("in_space", [False, True])
def test_viewers_are_shown_where_the_pole_stands(in_space: bool) -> None:
    """In the world; and nothing, once, when nothing is known any more."""
    _, reports = looked("ardupilot", in_space=in_space)
    eye = np.array([0.0, 0.08 * 11 - 0.88, -3.0])
    shown = reports.shown[-1]
    assert shown.eye_world == pytest.approx(eye, abs=1e-6)
    assert len(shown.edges_world) and not len(shown.free_world)
    middles = shown.edges_world.mean(1)
    assert np.linalg.norm((middles - [6.0, 0.8, -3.0])[:, :2], axis=1).min() < 0.6
    reports._clock.t_ns += MAX_AGE_NS  # type: ignore[attr-defined]
    n_before = len(reports.shown)
    reports.told()
    reports.told()
    (last,) = reports.shown[n_before:]
    assert not len(last.edges_world) and not len(last.free_world)


def test_viewers_are_shown_free_space_as_px4_is_told() -> None:
    (message,), reports = looked("px4")
    shown = reports.shown[-1]
    free = (shown.free_world - shown.eye_world).mean(1)
    sectors = np.round(np.degrees(np.arctan2(free[:, 1], free[:, 0])) / 5.0) % 72
    is_free = np.array(message.distances) == round(100 * FREE_M) + 1
    assert sorted(sectors) == np.flatnonzero(is_free).tolist() != []
    assert np.hypot(free[:, 0], free[:, 1]) == pytest.approx(FREE_M)


def test_in_space_ardupilot_is_told_where_the_pole_stands() -> None:
    """In body axes; PX4, which does not take such messages, is told distances."""
    (*things, last), reports = looked("ardupilot", in_space=True)
    assert things
    for each in things:
        assert each.get_type() == "OBSTACLE_DISTANCE_3D"
        assert np.hypot(each.x, each.y) == pytest.approx(np.hypot(6.0, 0.8), abs=0.6)
        assert np.arctan2(each.y, each.x) == pytest.approx(np.arctan2(0.8, 6.0), abs=0.06)
    # what tells that the round is over, and holds nothing
    assert (last.x, last.y, last.z) == (0.0, 0.0, 0.0)
    assert {each.time_boot_ms for each in things} == {last.time_boot_ms - 1}
    reports._clock.t_ns += MAX_AGE_NS  # type: ignore[attr-defined]
    assert len(reports.told()) == 1
    (message,), _ = looked("px4", in_space=True)
    assert message.get_type() == "OBSTACLE_DISTANCE"


def test_an_old_image_makes_everything_unknown_and_then_silent() -> None:
    """So that an autopilot does not hold what it was told before."""
    approach = Approach()
    assert set(approach.fly(2.0)) != {UNKNOWN}
    assert set(approach.fly(1e-9 * MAX_AGE_NS - 0.1, tracked=False)) != {UNKNOWN}
    assert set(approach.fly(0.2, tracked=False)) == {UNKNOWN}
    assert approach.fly(1e-9 * UNKNOWN_AFTER_NS, tracked=False) == []


def test_before_anything_is_known_all_is_unknown() -> None:
    """ArduPilot cannot be armed while its proximity sensor says nothing."""
    approach = Approach()
    assert set(approach.now()) == {UNKNOWN}
    assert set(approach.fly(1e-9 * UNKNOWN_AFTER_NS + 1.0, 0.0, tracked=False)) == {UNKNOWN}


def said_by(approach: Approach, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Texts to the pilot from now on."""
    said: list[str] = []

    def say(text: PilotText) -> bool:
        said.append(text.text)
        return True

    monkeypatch.setattr(approach.link, "say", say)
    return said


def test_the_pilot_is_told_when_obstacles_are_known_no_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    approach = Approach()
    said = said_by(approach, monkeypatch)
    approach.now()
    assert said == []  # nothing is lost that never was there
    approach.fly(2.0)
    assert said == ["Companion: obstacles in view are reported"]
    approach.fly(1e-9 * UNKNOWN_AFTER_NS - 0.1, tracked=False)
    assert len(said) == 1
    approach.fly(1e-9 * MAX_AGE_NS + 0.2, tracked=False)
    assert said[1:] == ["Companion: obstacles unknown: none is reported"]
    approach.fly(0.5)
    assert said[2:] == ["Companion: obstacles in view are reported"]


@pytest.mark.parametrize("firmware", ["px4", "ardupilot"])
def test_the_pilot_is_told_of_a_mount_that_never_lets_px4_move(
    firmware: Firmware, monkeypatch: pytest.MonkeyPatch
) -> None:
    approach = Approach()
    said = said_by(approach, monkeypatch)
    approach.link.vehicle = Vehicle(1, firmware, True, "")
    down = Pose(rotation_from_vector(np.array([0.0, -1.0, 0.0])) @ FORWARD.rotation, np.zeros(3))
    approach.reports.restart(replace(CAMERA, body_from_camera=down))
    approach.now()
    approach.now()
    told = ["Companion: no sector can be free: check the mount"]
    assert said == (told if firmware == "px4" else [])


@pytest.mark.parametrize("radius_m", [0.05, 0.1])
def test_how_thin_a_pole_is_found(radius_m: float) -> None:
    """A pole of 10 cm, 5 m ahead, is two pixels wide with 110 pixels of focal length."""
    approach = Approach(pole=(9.0, 0.0, radius_m))
    found = approach.fly(2.0)
    assert found[0] == pytest.approx(500, abs=55)


def test_rounds_are_made_again_by_their_notes() -> None:
    """Of depths, of images alone, for each firmware; and of an image that was gone by then."""
    approach = Approach()
    for _ in range(12):
        approach.fly(0.25)
    approach.fly(1e-9 * UNKNOWN_AFTER_NS + 1.0, tracked=False)
    assert len(approach.reports.points) > 3 and not approach.reports.steps[-1].sent
    assert approach.reports.sent_again(CAMERA) == payloads_of(approach.reports.sent)
    firmwares: tuple[tuple[Firmware, bool], ...] = (
        ("px4", False), ("ardupilot", False), ("ardupilot", True),
    )  # fmt: skip
    for firmware, in_space in firmwares:
        _, reports = looked(firmware, in_space=in_space)
        *_, frame, track = reports.came
        reports.frame(replace(frame, seq=99, grey=255 - frame.grey))
        reports.take(replace(track, seq=99))
        for n in range(100, 100 + MOST_TRACKS):
            reports.frame(replace(frame, seq=n))
        reports.told()
        assert not reports.steps[-1].values["has_image"]
        reports.take(replace(track, seq=n))
        reports.told()
        assert reports.steps[-1].values["has_image"]
        assert reports.sent_again(EYE) == payloads_of(reports.sent)


def test_nothing_is_told_of_the_flight_before() -> None:
    approach = Approach()
    approach.fly(2.0)
    look = approach.reports.look()
    n_steps = len(approach.reports.steps)
    approach.reports.restart(CAMERA)
    assert approach.reports.tell(look, *look.found()) == []
    assert len(approach.reports.steps) == n_steps


def test_it_goes_out_ten_times_a_second() -> None:
    approach = Approach()
    approach.fly(2.0)
    approach.link.alive = True

    async def fly() -> int:
        task = asyncio.create_task(approach.reports.run())
        while len(approach.port.of("OBSTACLE_DISTANCE")) < 3:
            await asyncio.sleep(0.01)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        return len(approach.port.of("OBSTACLE_DISTANCE"))

    assert asyncio.run(asyncio.wait_for(fly(), 5.0)) >= 3


def test_chunks_and_flights_come_while_a_round_is_made() -> None:
    """Its thread would end with an error, and the daemon with it."""
    approach, errors, over = Approach(), [], threading.Event()
    approach.fly(3.0)
    switch_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)

    def rounds() -> None:
        try:
            while not over.is_set():
                approach.now()
        except Exception as error:
            errors.append(error)

    thread = threading.Thread(target=rounds)
    thread.start()
    ones = np.ones((500, 3), np.float32)
    try:
        for n in range(3000):
            rgb = np.zeros(ones.shape, np.uint8)
            one = ones[:, 0]
            approach.reports.take(
                PointChunk(n % 20, approach.clock.t_ns, ones, rgb, one, ones, one)
            )
            if n % 300 == 299:
                approach.reports.restart(CAMERA)
    finally:
        over.set()
        thread.join()
        sys.setswitchinterval(switch_s)
    assert errors == []
