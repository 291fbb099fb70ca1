"""OBSTACLE_DISTANCE on approaches to a wall, a pole, a branch and nothing, by measured depth.

    python -m tests.bench.obstacle_approach [--things wall,pole,branch,field] [--thin 0.3,0.1]

Each is flown towards, weaving a little, down to 3 m, by the localisation and depth stages in
lockstep and `VehicleReports` beside them, which is asked ten times a second, 60 ms after the
exposure of the newest frame. The true distance of a sector in the middle of the view is that of
what stands in the band of heights that is searched; right is a distance told, to ArduPilot, within
5 % + 0.3 m of it. Free is what PX4 is told to be. `--seed` is of all patterns and of how it weaves.
Depth comes as soon as it can be computed at
all: its time of computation is not counted.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np

from companion.config_file import load_config
from companion.daemon.obstacle_reports import ObstacleReports
from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose, yaw_rotation
from companion.messages import DepthMap, Frame, MapUpdate, Message, PointChunk, Track
from companion.obstacles.obstacle_sectors import (
    ABOVE_M,
    BELOW_M,
    FREE_M,
    MAX_M,
    SECTOR_DEG,
    UNKNOWN_CM,
)
from companion.runtime.in_order import InOrder, in_order_of_time
from companion.runtime.stage_protocol import Finish, Setup
from companion.runtime.stages import stage_named
from drivers.mavlink.vehicle import Firmware, Vehicle
from tests.support.autopilot.memory_link import SetClock, memory_link
from tests.support.autopilot.memory_port import MemoryPort
from tests.support.flights.approach_scene import ApproachScene, Rod, Sheet
from tests.support.flights.rendered_flight import START_NS, PathOf, telemetry_of

PITCH = np.radians(8.0)
FORWARD = Pose(
    np.array([[0.0, -np.sin(PITCH), np.cos(PITCH)], [1, 0, 0], [0, np.cos(PITCH), np.sin(PITCH)]]),
    np.zeros(3),
)
"""`body_from_camera` of a camera that looks ahead and a little down."""
CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, body_from_camera=FORWARD)
HEIGHT_M, SPEED_M_S, RATE_HZ = 3.0, 1.5, 15.0
FIRST_M, LAST_M = 20.0, 3.0
"""Distances at begin and end."""
LATE_NS = 60_000_000
IN_VIEW = range(-5, 6)
"""Sectors: the view is 65 degrees wide."""
FREE_CM = round(100 * FREE_M) + 1
BANDS_M = (0.0, 5.0), (5.0, 8.0), (8.0, 12.0), (12.0, MAX_M), (np.inf, np.inf)


def scene(thing: str, thick_m: float, seed: int = 0) -> ApproachScene:
    """Ground with a wall far behind, and a thing at north 0; or a field, with trees far away."""

    def wall(north: float, look: int, half: float, high: float) -> Sheet:
        return Sheet(
            np.array([north, -half, -high]),
            np.array([0, 2 * half, 0]),
            np.array([0, 0, high]),
            look,
        )

    things: list[Sheet | Rod] = [
        Sheet(np.array([-60.0, -60, 0]), np.array([120.0, 0, 0]), np.array([0, 120.0, 0]), 1),
        wall(34.0, 2, 40.0, 22.0),
    ]
    if thing == "field":
        things = [
            Sheet(np.array([-200.0, -200, 0]), np.array([400.0, 0, 0]), np.array([0, 400.0, 0]), 1)
        ]
        rng = np.random.default_rng(seed)
        for east in range(-150, 150, 10):
            tree = wall(rng.uniform(45, 80), 10 + east % 3, rng.uniform(5, 8), rng.uniform(3, 9))
            things.append(replace(tree, corner=tree.corner + [0, east, 0]))
    elif thing == "wall":
        things.append(wall(0.0, 3, 6.0, 7.0))
    elif thing == "pole":
        things.append(Rod(np.array([0, 0.4, 0.0]), np.array([0, 0.4, -7.0]), thick_m / 2, 4))
    else:
        ends = np.array([0, -2.5, -3.2]), np.array([0, 2.5, -2.9])
        things.append(Rod(*ends, thick_m / 2, 5))
        things.append(Rod(np.array([0, 2.5, 0.0]), np.array([0, 2.5, -7.0]), 0.2, 4))
    return ApproachScene([replace(each, look=each.look + 100 * seed) for each in things])


def path_of(seed: int) -> PathOf:
    """`ned_from_body`, weaving a little."""
    begin = np.random.default_rng(seed).uniform(0, 2 * np.pi, 3) if seed else np.zeros(3)

    def place(after_s: float) -> Pose:
        north = -FIRST_M + SPEED_M_S * after_s
        east = 0.6 * np.sin(0.8 * after_s + begin[0])
        down = -HEIGHT_M + 0.25 * np.sin(0.5 * after_s + begin[1])
        yaw = 0.03 * np.sin(0.4 * after_s + begin[2])
        return Pose(yaw_rotation(yaw), np.array([north, east, down]))

    return place


class Approach:
    """One approach, and what was told of it."""

    def __init__(self, thing: str, thick_m: float, seed: int = 0) -> None:
        self._scene, self._place = scene(thing, thick_m, seed), path_of(seed)
        self._clock = SetClock()
        self._clock.t_ns = START_NS
        config = load_config(None, ["feedback.obstacle_distance=true"])
        self._link = memory_link(MemoryPort(), self._clock, lambda _: None)
        self._reports = ObstacleReports(config.feedback, self._link, self._clock, lambda note: None)
        self._reports.restart(CAMERA)
        self._asked_ns = 0
        self.told: list[tuple[float, float, bool]] = []
        """Of each sector, each time: true distance of what stands there, what was told of it,
        metres, inf where farther than 20 m, nan where unknown, and whether it was free for PX4."""
        stages = [stage_named("localisation"), stage_named("depth")]
        run = InOrder(stages, Setup(config, CAMERA, is_live=False), self._watch, print)
        seconds = (FIRST_M - LAST_M) / SPEED_M_S
        frames = (self._frame(n) for n in range(round(seconds * RATE_HZ)))
        for message in in_order_of_time(telemetry_of(self._place, seconds), frames):
            run.feed(message)
            if isinstance(message, Frame):
                run.collect()
                self._compare(message)
        run.finish(lambda _: Finish(hurry=False))

    def _frame(self, n: int) -> Frame:
        grey = self._scene.picture(CAMERA, self._place(n / RATE_HZ) @ FORWARD)
        t_ns = START_NS + round(n / RATE_HZ * 1e9)
        frame = Frame(n, t_ns, grey, np.repeat(grey[..., None], 3, 2))
        self._reports.frame(frame)
        return frame

    def _watch(self, message: Message) -> None:
        if isinstance(message, Track | MapUpdate | DepthMap | PointChunk):
            self._reports.take(message)

    def _compare(self, frame: Frame) -> None:
        if frame.t_ns - self._asked_ns < 100_000_000:
            return
        self._asked_ns = frame.t_ns
        self._clock.t_ns = frame.t_ns + LATE_NS
        told: dict[str, Any] = {}
        firmwares: tuple[Firmware, ...] = ("ardupilot", "px4")
        for firmware in firmwares:
            self._link.vehicle = Vehicle(1, firmware, True, "")
            look = self._reports.look()
            messages = self._reports.tell(look, *look.found())
            if not messages:
                return
            (told[firmware],) = messages
        body = self._place((frame.t_ns - START_NS) * 1e-9)
        yaw = np.arctan2(body.rotation[1, 0], body.rotation[0, 0])
        within = np.radians(SECTOR_DEG * np.linspace(-0.5, 0.5, 25))
        for sector in IN_VIEW:
            bearings = yaw + np.radians(SECTOR_DEG * sector) + within
            at_m = self._scene.nearest_m(body.translation, bearings, ABOVE_M, BELOW_M)
            true_m = float(at_m.min())
            told_cm = told["ardupilot"].distances[sector % 72]
            told_m = np.nan if told_cm == UNKNOWN_CM else told_cm / 100
            is_free = told["px4"].distances[sector % 72] == FREE_CM
            self.told.append((true_m if true_m <= MAX_M else np.inf, told_m, is_free))

    def row(self, least_m: float, most_m: float) -> str:
        """What was told of sectors in which the nearest thing was that far away, as a row."""
        true_m, told_m, is_free = np.array(self.told, np.float64).T
        here = (true_m >= least_m) & (true_m <= most_m)
        true_m, told_m, is_free = true_m[here], told_m[here], is_free[here]
        is_told = np.isfinite(told_m)
        with np.errstate(invalid="ignore"):
            right = is_told & np.isfinite(true_m) & (np.abs(told_m - true_m) <= 0.05 * true_m + 0.3)
            far = is_told & (told_m > 1.05 * true_m + 0.3)
        counts = right, is_told & ~right & ~far, far, np.isnan(told_m), is_free
        return " | ".join(str(n) for n in (len(true_m), *(int(c.sum()) for c in counts)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--things", default="wall,pole,branch,field")
    parser.add_argument("--thin", default="0.3", help="thickness of pole and branch, metres")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print("| thing | true distance | sectors | right | too near | too far | unknown | free |")
    print("|---|---|---|---|---|---|---|---|")
    for thing in options.things.split(","):
        is_thin = thing in ("pole", "branch")
        for thick in [float(t) for t in options.thin.split(",")] if is_thin else [1.0]:
            flown = Approach(thing, thick, options.seed)
            for least_m, most_m in BANDS_M:
                band = f"{least_m:g} to {most_m:g} m" if least_m < np.inf else "beyond 20 m"
                row = flown.row(least_m, most_m)
                print(f"| {thing} {thick:g} m | {band} | {row} |", flush=True)


if __name__ == "__main__":
    main()
