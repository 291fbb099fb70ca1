"""Depth engine on a data set with ground truth, beside REMODE's filter on one core.

One reference is measured with its range of depths taken from the truth, as REMODE's filter has it;
then all that `companion depth` makes of the data set by itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time

import numpy as np

from companion.app.depth_command import Wanted, reconstruct
from companion.app.progress import Progress
from companion.compute.compute_devices import choose_device
from companion.config import Config
from companion.dense.engine import DepthEngine
from companion.dense.undistortion import Undistortion
from companion.dense.view_selection import Intrinsics
from companion.errors import FlightError
from companion.geometry.transforms import Pose
from companion.messages import Bytes, DepthMap, Floats, PixelState
from companion.timing.clock import StageTimes
from drivers.posed_images import PosedImages, open_posed_images
from tests.bench.accuracy.depth_accuracy import Accuracy, accuracy
from tests.bench.accuracy.depth_results import (
    AfterFrames,
    AsUsed,
    AtThreshold,
    DepthBench,
    ReferenceAsUsed,
    Timed,
)
from tests.bench.accuracy.depth_tables import write_bench
from tests.bench.accuracy.remode_serial import RemodeSerial
from tests.bench.accuracy.true_depths import true_depth

CHECKPOINTS = (1, 5, 10, 15, 20, 25, 30, 40, 50, 75, 100, 150, 200, 300, 400)
THRESHOLDS = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """Common input: undistorted images, poses current_from_reference, true depth and its range."""

    grey: Bytes
    others: list[tuple[Bytes, Pose]]
    truth: Floats
    ray_length: Floats
    intrinsics: Intrinsics
    near: float
    far: float


def bench_depth(
    path: Path, config: Config, out: Path | None, *,
    reference: int, frames: tuple[int | None, int | None], serial: bool, progress: Progress,
) -> DepthBench:  # fmt: skip
    """Measure, and write depth_bench.json and pictures into `out`; FlightError without truth."""
    images = open_posed_images(path)
    scene = _scene(images, reference, frames)
    device = choose_device(config.opencl)
    full = replace(config.depth, stride=1)
    height, width = scene.grey.shape
    engine = DepthEngine(device, width, height, scene.intrinsics, full)
    stops = [n for n in CHECKPOINTS if n < len(scene.others)] + [len(scene.others)]
    progress.start(len(stops) + len(THRESHOLDS) + 1 + (len(scene.others) if serial else 0))
    done = 0

    def step(state: str) -> None:
        nonlocal done
        done += 1
        progress.update(done, state, 0)

    try:
        _run(engine, scene, scene.others)  # compilers and caches are warm from here on
        step("warming up")
        timed, depth_map = _run(engine, scene, scene.others)
        searched = engine.n_searched
        after = []
        for n in stops:
            some, at = _run(engine, scene, scene.others[:n])
            left = float((at.state == PixelState.UPDATING.value).mean())
            after.append(
                AfterFrames(n, left, 1e3 * some.wall_s / n, some.converged, some.all_pixels)
            )
            step(f"{n} frames")
        thresholds = []
        for least in THRESHOLDS:
            other = DepthEngine(
                device, width, height, scene.intrinsics, replace(full, min_zncc=least), eager=False
            )
            thresholds.append(AtThreshold(least, _run(other, scene, scene.others)[0].converged))
            step(f"min_zncc {least}")
        runs = [timed]
        serial_after: list[AfterFrames] = []
        if serial:
            run, serial_after = _run_serial(scene, stops, lambda: step("serial reference"))
            runs.append(run)
    finally:
        progress.finish()
    as_used = _as_used(images, config, frames, progress)
    bench = DepthBench(
        str(path), device.described, width, height, len(scene.others), searched, tuple(runs),
        {name: round(ms, 2) for name, ms in depth_map.kernel_ms.items()}, tuple(after),
        tuple(serial_after), tuple(thresholds), as_used,
    )  # fmt: skip
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        write_bench(out, bench)
    return bench


def _as_used(
    images: PosedImages, config: Config, frames: tuple[int | None, int | None], progress: Progress
) -> AsUsed:
    full = replace(config, depth=replace(config.depth, stride=1))
    prepared = Undistortion(images.camera)
    truths: dict[int, Floats] = {}
    before: dict[int, tuple[Accuracy, Accuracy]] = {}

    def look(depth_map: DepthMap) -> None:
        truth = true_depth(images, images.numbers.index(depth_map.keyframe_id))
        if truth is not None:
            truths[depth_map.keyframe_id] = prepared.nearest(truth)
            before[depth_map.keyframe_id] = _judged(depth_map, truths[depth_map.keyframe_id])

    times = StageTimes()
    cpu = process_time()
    try:
        with times("all"):
            maps = reconstruct(images.path, None, full, Wanted(None, frames, None), progress, look)
    except FlightError as error:
        return AsUsed(0, 0.0, 0.0, (), str(error))
    cpu = process_time() - cpu
    rows = tuple(
        ReferenceAsUsed(m.keyframe_id, *before[m.keyframe_id], *_judged(m, truths[m.keyframe_id]))
        for m in maps
        if m.keyframe_id in truths
    )
    return AsUsed(len(maps), times.total_ms("all") / 1e3 / len(maps), cpu / len(maps), rows)


def _judged(depth_map: DepthMap, truth: Floats) -> tuple[Accuracy, Accuracy]:
    """Accuracy of converged pixels, and of all."""
    converged = depth_map.state == PixelState.CONVERGED.value
    return (
        accuracy(depth_map.depth, truth, converged),
        accuracy(depth_map.depth, truth, np.ones_like(converged)),
    )


def _scene(images: PosedImages, reference: int, frames: tuple[int | None, int | None]) -> _Scene:
    at = images.position(reference)
    truth, pose = true_depth(images, at), images.poses[at]
    if truth is None or pose is None:
        raise FlightError(f"{images.path}: frame {reference} has no true depth")
    first = 0 if frames[0] is None else frames[0]
    beyond = math.inf if frames[1] is None else frames[1]
    positions = [
        i
        for i, number in enumerate(images.numbers)
        if i != at and first <= number < beyond and images.poses[i] is not None
    ]
    if not positions:
        raise FlightError(f"{images.path}: --frames names no image with a pose")
    prepared = Undistortion(images.camera)
    greys = {i: prepared.grey(rgb) for i, rgb in images.pictures(sorted([at, *positions]))}
    positions.sort(key=lambda i: (abs(i - at), i))
    others = [(greys[i], _known(images.poses[i]).inverse() @ pose) for i in positions]
    # the truth lies in the camera's own image: to that of the ideal camera by nearest neighbour
    depth = prepared.nearest(truth)
    known = depth[depth > 0]
    return _Scene(
        greys[at], others, depth, prepared.ray_length(), prepared.intrinsics,
        float(known.min()), float(known.max()),
    )  # fmt: skip


def _known(pose: Pose | None) -> Pose:
    assert pose is not None
    return pose


def _run(
    engine: DepthEngine, scene: _Scene, others: Sequence[tuple[Bytes, Pose]]
) -> tuple[Timed, DepthMap]:
    times = StageTimes()
    cpu = process_time()
    rgb = np.repeat(scene.grey[..., None], 3, 2)
    with times("update"):
        engine.begin(scene.grey, scene.near, scene.far)
        for grey, pose in others:
            engine.update(grey, pose)
    with times("finish"):
        out = engine.finish(0, 0, rgb)
    cpu = process_time() - cpu
    return Timed(
        "companion", times.total_ms("update") / 1e3, times.total_ms("finish") / 1e3, cpu,
        *_judged(out, scene.truth),
    ), out  # fmt: skip


def _run_serial(
    scene: _Scene, stops: Sequence[int], step: Callable[[], None]
) -> tuple[Timed, list[AfterFrames]]:
    distance = scene.truth * scene.ray_length
    near, far = float(distance[distance > 0].min()), float(distance.max())
    k = scene.intrinsics
    times = StageTimes()
    used_s, after = 0.0, []
    every = np.ones(scene.truth.shape, bool)
    filter_ = RemodeSerial(scene.grey, (k.fx, k.fy, k.cx, k.cy), near, far)
    try:
        for n, (grey, pose) in enumerate(scene.others, 1):
            cpu = process_time()
            with times("update"):
                filter_.update(grey, pose)
            used_s += process_time() - cpu
            if n in stops:
                depth, converged = filter_.state()
                after.append(
                    AfterFrames(
                        n, float(1 - converged.mean()), times.total_ms("update") / n,
                        accuracy(depth / scene.ray_length, scene.truth, converged),
                        accuracy(depth / scene.ray_length, scene.truth, every),
                    )
                )  # fmt: skip
            step()
        depth, converged = filter_.state()
        cpu = process_time()
        with times("finish"):
            smooth = filter_.denoised()
        used_s += process_time() - cpu
    finally:
        filter_.close()
    return Timed(
        "REMODE, one core", times.total_ms("update") / 1e3, times.total_ms("finish") / 1e3, used_s,
        accuracy(depth / scene.ray_length, scene.truth, converged),
        accuracy(smooth / scene.ray_length, scene.truth, every),
    ), after  # fmt: skip
