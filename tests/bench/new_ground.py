"""An hour over new ground: growth of the time per frame and of memory.

    python -m tests.bench.new_ground [--frames 36000] [--rows 12] [--copies 11] [--end]

Lanes of a survey over ground of dead leaves that never repeats, rendered at 480x360 and 10
frames/s, with the autopilot's telemetry; in lockstep, without dense depth. Prints a row for each
twelfth of the flight: processor time until a frame's pose (median, 95th percentile), of a keyframe,
what the process has written in memory, and in a file in the folder for temporary
ones. With `--copies` the map is joined, after half of the flight, with so many copies of itself,
each further away: it then is as large as after a flight so much longer. With `--end` the flight
then ends: how long that takes, and the memory then.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ[variable] = "1"  # as the program does, before numpy loads

import cv2  # noqa: E402
import numpy as np  # noqa: E402

from companion.config import Config  # noqa: E402
from companion.estimation.localisation import LocalisationStage  # noqa: E402
from companion.geometry.camera import Camera  # noqa: E402
from companion.geometry.transforms import (  # noqa: E402
    Array,
    Pose,
    Similarity,
    rotation_from_vector,
)
from companion.messages import Bytes, Frame, KeyframeAdded, Odometry, TrackState  # noqa: E402
from companion.products.array_file import ArrayFile  # noqa: E402
from companion.products.site_map_file import write_site_map  # noqa: E402
from companion.runtime.in_order import in_order_of_time  # noqa: E402
from companion.slam.map.map_part import map_of, part_of  # noqa: E402
from companion.timing.clock import StageTimes  # noqa: E402
from drivers.system.heap import bound_heap  # noqa: E402
from tests.support.flights.rendered_flight import (  # noqa: E402
    CAMERA_DOWN,
    METRES_PER_TEXEL,
    Terrain,
    telemetry_of,
)
from tests.support.flights.scene import leaves  # noqa: E402

CAMERA = Camera(480, 360, 400.0, 400.0, 239.5, 179.5, body_from_camera=CAMERA_DOWN)
RATE_HZ, SPEED_M_S, HEIGHT_M = 10.0, 8.0, 40.0
LANE_M, APART_M = 600.0, 20.0
"""Neighbouring lanes share some ground."""
N_PATTERNS, SIDE = 8, 512
START_NS = 1_700_000_000_000_000_000
FOLDER = Path(tempfile.gettempdir())
COPIES_APART, IDS_APART = 1000.0, 100_000
"""In map units, the first keyframes' distance; and of numbers of keyframes."""


class NewGround(Terrain):
    """Squares of ground, each a pattern of its own: one of some, shifted and turned over."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed, plane=True, pattern=lambda rng: leaves(rng, 64))
        rng = np.random.default_rng(seed)
        self._patterns = [leaves(rng, SIDE) for _ in range(N_PATTERNS)]

    def picture(self, camera: Camera, ned_from_camera: Pose) -> Bytes:
        """What the camera sees (H, W) of flat ground."""
        rays = self._rays_of(camera) @ ned_from_camera.rotation.T.astype(np.float32)
        away = np.float32(-ned_from_camera.translation[2]) / rays[..., 2]
        texel_m = 2.0 * METRES_PER_TEXEL
        row, column = (
            ((np.float32(c) + away * rays[..., k]) / np.float32(texel_m)).astype(np.float32)
            for k, c in enumerate(ned_from_camera.translation[:2] % (SIDE * texel_m))
        )
        origin = np.floor(ned_from_camera.translation[:2] / (SIDE * texel_m)).astype(int)
        out = np.zeros((camera.height, camera.width), np.uint8)
        across, along = np.floor(column / SIDE), np.floor(row / SIDE)
        for i in range(int(along.min()), int(along.max()) + 1):
            for j in range(int(across.min()), int(across.max()) + 1):
                which = np.random.default_rng([*(origin + [i, j] + 10_000).tolist()])
                pattern = self._patterns[which.integers(N_PATTERNS)]
                shift, turned = which.integers(0, SIDE, 2), which.integers(0, 2, 2) * 2 - 1
                x, y = (
                    np.mod(t * v + s, SIDE).astype(np.float32)
                    for t, v, s in zip(turned, (column, row), shift, strict=True)
                )
                drawn = cv2.remap(pattern, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
                here = (along == i) & (across == j)
                out[here] = drawn[here]
        return out


def place_m(after_s: float) -> Array:
    """Lanes to and fro northward, each further east; the turns are half circles."""
    turn_m = 0.5 * np.pi * APART_M
    lane, along = divmod(max(SPEED_M_S * after_s, 0.0), LANE_M + turn_m)
    north, east = min(along, LANE_M), 0.0
    if along > LANE_M:
        angle = (along - LANE_M) / (0.5 * APART_M)
        north = LANE_M + 0.5 * APART_M * np.sin(angle)
        east = 0.5 * APART_M * (1.0 - np.cos(angle))
    if int(lane) % 2:
        north = LANE_M - north
    weave = np.array([0.0, 1.5 * np.sin(0.3 * after_s), 1.5 * np.sin(0.17 * after_s)])
    out: Array = np.array([north, lane * APART_M + east, -HEIGHT_M]) + weave
    return out


def ned_from_body(after_s: float) -> Pose:
    lean = rotation_from_vector(0.04 * np.sin(np.array([1.3, 1.7, 0.0]) * after_s))
    return Pose(lean, place_m(after_s))


def frames(n: int) -> Iterator[Frame]:
    ground, nothing = NewGround(4), np.zeros((0, 0, 3), np.uint8)
    for seq in range(n):
        after_s = seq / RATE_HZ
        grey = ground.picture(CAMERA, ned_from_body(after_s) @ CAMERA_DOWN)
        yield Frame(seq, START_NS + round(after_s * 1e9), grey, nothing)


def written_mb() -> float:
    """Memory that the process has written: pages of files are the system's to take."""
    status = Path("/proc/self/status").read_text("ascii")
    return int(status.partition("RssAnon:")[2].split()[0]) * 1024e-6


def join_copies(stage: LocalisationStage, file: ArrayFile, n: int) -> None:
    """Join the map with copies of itself, as if these had been flown before."""
    slam_map, database = stage._tracker.map, stage._tracker.atlas._database
    first = map_of(part_of(slam_map, slam_map.keyframes), slam_map.scale_factor, slam_map.n_levels)
    for i in range(1, n + 1):
        away = np.array([i * COPIES_APART, 0.0, 0.0])
        offset = slam_map.append_points(first, Similarity(1.0, np.eye(3), away))
        ids = np.arange(offset, offset + first.n_points)
        for each in (slam_map.observers, slam_map.born, slam_map.first_seen):
            each[ids] -= np.where(each[ids] >= 0, i * IDS_APART, 0)
        ids = ids[slam_map.patch_at[ids] >= 0]
        (grey,) = file.put([slam_map.patches_of(ids).grey]) or [None]
        slam_map.put_patches_away(ids, grey)
        for key, keyframe in first.keyframes.items():
            copy = replace(
                keyframe, keyframe_id=key - i * IDS_APART,
                camera_from_map=keyframe.camera_from_map @ Pose(np.eye(3), -away),
                point_ids=np.where(keyframe.point_ids >= 0, keyframe.point_ids + offset, -1),
                t_ns=keyframe.t_ns - i * 3_600_000_000_000,
            )  # fmt: skip
            slam_map.keyframes[copy.keyframe_id] = copy
            slam_map.leave_behind(copy)
            database.add(copy.keyframe_id, copy.features.descriptors)
    slam_map.keyframes = dict(sorted(slam_map.keyframes.items()))
    slam_map.keyframes_moved()


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=int, default=36_000)
    parser.add_argument("--rows", type=int, default=12)
    parser.add_argument("--copies", type=int, default=0)
    parser.add_argument("--end", action="store_true")
    options = parser.parse_args()
    bound_heap()
    stage, file = LocalisationStage(Config(), CAMERA, StageTimes()), ArrayFile(FOLDER)
    stage.put_far_into(file)
    stage._tracker.keyframes.next_id = options.copies * IDS_APART
    pose_ms: list[float] = []
    keyframe_ms: list[float] = []
    n_tracked = 0
    samples = telemetry_of(ned_from_body, options.frames / RATE_HZ)
    print(
        "| frames | tracked | pose, median, 95th | keyframe | keyframes | memory | file |\n"
        + "|---" * 7
    )
    for message in in_order_of_time(samples, frames(options.frames)):
        began_ns, is_keyframe, ms = time.thread_time_ns(), False, 0.0
        for out in stage.step(message):
            is_keyframe |= isinstance(out, KeyframeAdded)
            if isinstance(out, Odometry):
                ms = (time.thread_time_ns() - began_ns) * 1e-6
                n_tracked += out.state is TrackState.TRACKING
        if not isinstance(message, Frame):
            continue
        if is_keyframe:
            keyframe_ms.append((time.thread_time_ns() - began_ns) * 1e-6)
        else:
            pose_ms.append(ms)
        every = options.frames // options.rows
        if (message.seq + 1) % every == 0:
            print(
                f"| {message.seq + 1} | {100 * n_tracked / every:.0f} % | "
                f"{np.median(pose_ms):.1f}, {np.percentile(pose_ms, 95):.1f} ms | "
                f"{np.median(keyframe_ms or [np.nan]):.0f} ms | {len(keyframe_ms)} | "
                f"{written_mb():.0f} MB | {file.n_bytes / 1e6:.0f} MB |",
                flush=True,
            )  # fmt: skip
            pose_ms, keyframe_ms, n_tracked = [], [], 0
        if options.copies and message.seq == options.frames // 2 - 1:
            join_copies(stage, file, options.copies)
            print(f"joined: {len(stage._tracker.map.keyframes)} keyframes", flush=True)
    if options.end:
        began_s = time.monotonic()
        stage.finish()
        adjusted_s = time.monotonic()
        site = stage.site_map("new ground", None)
        assert site is not None
        write_site_map(FOLDER / "new_ground.map", site)
        print(
            f"adjusted in {adjusted_s - began_s:.0f} s, map of {len(site.keyframes)} keyframes and "
            f"{len(site.points.positions)} points in {time.monotonic() - adjusted_s:.0f} s, "
            f"{(FOLDER / 'new_ground.map').stat().st_size / 1e6:.0f} MB; {written_mb():.0f} MB then"
        )


if __name__ == "__main__":
    main()
