"""`companion depth`: depth of reference frames from images with known poses."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from companion.app.progress import Progress
from companion.compute.compute_devices import choose_device
from companion.config import Config
from companion.dense.consensus import Consensus
from companion.dense.depth_range import depth_range
from companion.dense.engine import DepthEngine
from companion.dense.fusion import Fusion, chunk_alone
from companion.dense.opencl import ComputeDevice
from companion.dense.undistortion import Undistortion
from companion.dense.view_selection import MAX_BASELINE
from companion.errors import FlightError
from companion.geometry.transforms import Pose
from companion.messages import Bytes, DepthMap, MapUpdate, PixelState, PointChunk
from companion.products.depth_files import write_cloud, write_depth
from companion.products.depth_log import ReferenceLog, Spent, UpdateLog, write_log
from companion.timing.clock import StageTimes
from drivers.open_flight import format_of
from drivers.posed_images import PosedImages, open_posed_images

MAX_TURN_RAD = np.radians(35.0)
RANGE_FRAMES = 60
"""Images over which points are tracked to find the depth range."""
MAX_FRAMES = 400
"""Most images around one reference."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """Selection: one reference or all, frames A to B.

    `range_m` is the least and the greatest depth; None has them estimated for each reference.
    """

    reference: int | None
    frames: tuple[int | None, int | None]
    range_m: tuple[float, float] | None


class Reconstruction:
    """Depth engine on one data set; caches undistorted images."""

    def __init__(self, images: PosedImages, config: Config, device: ComputeDevice) -> None:
        self.images = images
        self._undistortion = Undistortion(images.camera)
        camera = images.camera
        self.times = StageTimes()
        self.engine = DepthEngine(
            device, camera.width, camera.height, self._undistortion.intrinsics, config.depth
        )
        self._kept: dict[int, Bytes] = {}
        self.log: list[ReferenceLog] = []

    def picture(self, position: int) -> Bytes:
        """Undistorted RGB image (H, W, 3) at a position."""
        if position not in self._kept:
            for at, rgb in self.images.pictures([position]):
                self._kept[at] = self._undistortion.image(rgb)
        return self._kept[position]

    def load(self, positions: list[int]) -> None:
        """Load these images and drop all others."""
        self._kept = {p: self._kept[p] for p in positions if p in self._kept}
        missing = [p for p in positions if p not in self._kept]
        for at, rgb in self.images.pictures(missing):
            self._kept[at] = self._undistortion.image(rgb)

    def grey(self, position: int) -> Bytes:
        """Undistorted grey image (H, W) at a position."""
        return np.asarray(cv2.cvtColor(self.picture(position), cv2.COLOR_RGB2GRAY), np.uint8)

    def pose(self, position: int) -> Pose:
        """Pose world_from_camera; only of positions that have one."""
        pose = self.images.poses[position]
        assert pose is not None
        return pose

    def found_range(self, reference: int, positions: list[int]) -> tuple[float, float] | None:
        """Least and greatest depth of a reference, from the images after it, else before it."""
        later = [p for p in positions if p > reference][:RANGE_FRAMES]
        earlier = [p for p in reversed(positions) if p < reference][:RANGE_FRAMES]
        chosen = max(later, earlier, key=len)
        self.load(sorted([reference, *chosen]))
        others = ((self.grey(p), self.pose(p).inverse() @ self.pose(reference)) for p in chosen)
        return depth_range(self.grey(reference), others, self._undistortion.intrinsics)

    def of_reference(
        self, reference: int, positions: list[int], range_m: tuple[float, float], reach_m: float
    ) -> DepthMap:
        """Depth map of a reference from those images that are near it; adds to the log."""
        others = _others(self.images, positions, reference, reach_m)
        self.load([reference, *others])
        found, updates, spent = self._depth_map(reference, others, *range_m)
        number, n_searched = self.images.numbers[reference], self.engine.n_searched
        self.log.append(ReferenceLog(number, range_m, n_searched, tuple(updates), spent))
        return found

    def _depth_map(
        self, reference: int, others: list[int], near_m: float, far_m: float
    ) -> tuple[DepthMap, list[UpdateLog], Spent]:
        """Depth map from images in this order; log of each update; total time."""
        engine, begun_ms = self.engine, self._wall_ms()
        with self.times("begin"):
            engine.begin(self.grey(reference), near_m, far_m)
        updates = []
        for position in others:
            grey = self.grey(position)
            current_from_reference = self.pose(position).inverse() @ self.pose(reference)
            first, before = engine.n_commands(), self.times.total_ms("update")
            with self.times("update"):
                n_worked = engine.update(grey, current_from_reference)
            updates.append((position, n_worked, self._labels(), first, before))
        ends = [*(u[3] for u in updates[1:]), engine.n_commands()]
        ends_ms = [*(u[4] for u in updates[1:]), self.times.total_ms("update")]
        with self.times("finish"):
            out = engine.finish(
                self.images.numbers[reference], self.images.numbers[reference],
                self.picture(reference),
            )  # fmt: skip
        log = [
            UpdateLog(
                self.images.numbers[position], n_worked, *labels,
                Spent.of(end_ms - before, engine.device_ms(first, end)),
            )
            for (position, n_worked, labels, first, before), end, end_ms in zip(
                updates, ends, ends_ms, strict=True
            )
        ]  # fmt: skip
        return out, log, Spent.of(self._wall_ms() - begun_ms, engine.device_ms())

    def _wall_ms(self) -> float:
        return sum(self.times.total_ms(name) for name in ("begin", "update", "finish"))

    def _labels(self) -> tuple[int, int]:
        labels = self.engine.labels
        return tuple(
            int((labels == s.value).sum()) for s in (PixelState.CONVERGED, PixelState.DIVERGED)
        )  # type: ignore[return-value]


def reconstruct(
    path: Path, out: Path | None, config: Config, wanted: Wanted, progress: Progress,
    alone: Callable[[DepthMap], None] | None = None,
) -> list[DepthMap]:  # fmt: skip
    """Depth of the selected references; with their cloud and depth.json into the folder `out`.

    `alone` is called with each map before the consensus with other references.
    """
    images = open_posed_images(path)
    device = choose_device(config.opencl)
    work = Reconstruction(images, config, device)
    positions = _positions(images, wanted.frames)
    first = positions[0] if wanted.reference is None else images.position(wanted.reference)
    range_m = wanted.range_m or work.found_range(first, positions)
    if range_m is None:
        raise FlightError(
            f"{path}: too few points of frame {images.numbers[first]} can be followed to tell how "
            "far away things are: give --range NEAR:FAR"
        )
    middle_m = float(np.sqrt(range_m[0] * range_m[1]))
    single = wanted.reference is not None
    references = [first] if single else _references(images, positions, middle_m, config)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    fusion, consensus = Fusion(config.cloud), Consensus(config.depth)
    n_written = 0
    chunks: list[PointChunk] = []
    done: list[DepthMap] = []
    numbers = images.numbers
    places = {numbers[p]: pose for p in positions if (pose := images.poses[p]) is not None}
    update = MapUpdate(0, 0, places, np.zeros((0, 3)), None)
    progress.start(len(references))
    try:
        for n, reference in enumerate(references, 1):
            if wanted.range_m is None and n > 1:
                range_m = work.found_range(reference, positions) or range_m
            reach_m = np.inf if single else MAX_BASELINE * math.sqrt(range_m[0] * range_m[1])
            depth_map = work.of_reference(reference, positions, range_m, reach_m)
            if alone is not None:
                alone(depth_map)
            if single:
                done.append(depth_map)
            else:
                done += consensus.add(depth_map, work.pose(reference))
                chunks += fusion.add(depth_map, update)
            _write(out, done[n_written:])
            n_written = len(done)
            progress.update(n, f"frame {numbers[reference]}", sum(len(c.rgb) for c in chunks))
    finally:
        progress.finish()
    done += consensus.flush()
    _write(out, done[n_written:])
    if out is None:
        return done
    chunks += [chunk_alone(done[0])] if single else fusion.flush(update)
    write_cloud(out, chunks, places)
    write_log(
        out, device=device.described, layout=format_of(path).name, maps=done,
        log=work.log, stages=work.times.summary(),
    )  # fmt: skip
    return done


def _write(out: Path | None, maps: Sequence[DepthMap]) -> None:
    if out is not None:
        for each in maps:
            write_depth(out, each)


def _positions(images: PosedImages, frames: tuple[int | None, int | None]) -> list[int]:
    first = 0 if frames[0] is None else frames[0]
    beyond = max(images.numbers) + 1 if frames[1] is None else frames[1]
    out = [
        i
        for i, number in enumerate(images.numbers)
        if first <= number < beyond and images.poses[i] is not None
    ]
    if len(out) < 2:
        raise FlightError(f"{images.path}: --frames names fewer than two images with a pose")
    return out


def _references(
    images: PosedImages, positions: list[int], middle_m: float, config: Config
) -> list[int]:
    half_view = float(np.arctan(0.5 * images.camera.width / images.camera.fx))
    out = [positions[0]]
    for position in positions[1:]:
        relative = _relative(images, out[-1], position)
        step = float(np.linalg.norm(relative.translation)) / middle_m
        turn = float(np.arccos(np.clip(relative.rotation[2, 2], -1, 1)))
        if step > config.depth.reference_step or turn > 0.35 * half_view:
            out.append(position)
    return out


def _others(images: PosedImages, positions: list[int], reference: int, reach_m: float) -> list[int]:
    """Nearby images with a similar viewing direction, the nearest in time first."""
    out = []
    for position in positions:
        relative = _relative(images, reference, position)
        turn = np.arccos(np.clip(relative.rotation[2, 2], -1, 1))
        near = float(np.linalg.norm(relative.translation)) <= reach_m
        if position != reference and near and (turn < MAX_TURN_RAD or reach_m == np.inf):
            out.append(position)
    return sorted(out, key=lambda p: (abs(p - reference), p))[:MAX_FRAMES]


def _relative(images: PosedImages, a: int, b: int) -> Pose:
    first, second = images.poses[a], images.poses[b]
    assert first is not None and second is not None
    return first.inverse() @ second
