"""Self-test and benchmark of a device on a small scene of known depth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources

import numpy as np

from companion.config import DepthConfig
from companion.dense.engine import DepthEngine
from companion.dense.opencl import ComputeDevice
from companion.dense.view_selection import Intrinsics
from companion.errors import DeviceError
from companion.geometry.transforms import Array, Pose
from companion.messages import Bytes, DepthMap

VALUES = "self_test.npz"
SIZE = (97, 65)
"""Odd, so that rows are not vector-aligned."""
FAR, NEAR = 10.0, 5.0
SHIFTS_PX = ((4, 0), (-4, 0), (0, 4), (6, 4), (-6, -4), (8, -4))
"""Disparity of the far plane in each image; that of the near one is twice as large."""
NOISE = 0.005
"""Relative depth difference allowed for rounding."""
MIN_AGREEING = 0.99
SPEED_SIZE = (640, 480)
SPEED_S = 2.0


@dataclass(frozen=True, slots=True)
class Scene:
    """Images of a square in front of a wall, the first the reference, and poses of the others."""

    images: tuple[Bytes, ...]
    poses: tuple[Pose, ...]
    intrinsics: Intrinsics
    depth: Array


def scene(width: int, height: int) -> Scene:
    """Scene of integer values and disparities: bit-exact everywhere."""
    margin = 16
    pattern = _pattern(width + 4 * margin, height + 4 * margin)
    v, u = np.indices((height, width))
    focal = 0.8 * width
    images, poses, depth = [], [], np.zeros((height, width))
    for dx, dy in ((0, 0), *SHIFTS_PX):
        left, top = width // 3 + 2 * dx, height // 3 + 2 * dy
        near = (u >= left) & (u < left + width // 3) & (v >= top) & (v < top + height // 3)
        wall = pattern[v - dy + margin, u - dx + margin]
        square = pattern.T[(u - 2 * dx) % height + margin, (v - 2 * dy) % width + margin]
        images.append(np.where(near, square, wall).astype(np.uint8))
        poses.append(Pose(np.eye(3), np.array([dx, dy, 0]) * FAR / focal))
        if (dx, dy) == (0, 0):
            depth = np.where(near, NEAR, FAR)
    camera = Intrinsics(focal, focal, 0.5 * (width - 1), 0.5 * (height - 1))
    return Scene(tuple(images), tuple(poses[1:]), camera, depth)


def _pattern(width: int, height: int) -> Bytes:
    """Multi-scale texture by a linear congruential generator."""
    side = max(width, height)
    out = np.zeros((side, side), np.int64)
    seed = 12345
    for cell in (2, 5, 11):
        n = -(-side // cell)
        values = np.zeros(n * n, np.int64)
        for i in range(n * n):
            seed = (seed * 1103515245 + 12345) % 2147483648
            values[i] = seed // 65536 % 81
        out += np.repeat(np.repeat(values.reshape(n, n), cell, 0), cell, 1)[:side, :side]
    return out.astype(np.uint8)


def engine_for(device: ComputeDevice, it: Scene) -> DepthEngine:
    """An engine for every pixel of the scene."""
    height, width = it.images[0].shape
    # so small an image determines depth to some per cent only
    config = DepthConfig(stride=1, converged_sigma=0.1)
    return DepthEngine(device, width, height, it.intrinsics, config, eager=False)


def reconstruct(engine: DepthEngine, it: Scene) -> DepthMap:
    """Depth of the scene by an engine."""
    engine.begin(it.images[0], 0.7 * NEAR, 2.0 * FAR)
    for image, pose in zip(it.images[1:], it.poses, strict=True):
        engine.update(image, pose)
    return engine.finish(0, 0, np.repeat(it.images[0][..., None], 3, 2))


class SelfTest:
    """Repeatable self-test of a device. Raises DeviceError where it cannot run."""

    def __init__(self, device: ComputeDevice) -> None:
        self._device = device
        self._scene = scene(*SIZE)
        self._engine = engine_for(device, self._scene)
        with (resources.files("companion.dense") / VALUES).open("rb") as file:
            values = np.load(file)
            self._depth, self._state = values["depth"].astype(np.float64), values["state"]

    def run(self) -> None:
        """DeviceError where the result differs from the stored one."""
        found = reconstruct(self._engine, self._scene)
        failed = f"{self._device.name}: self-test failed"
        if not np.isfinite(found.depth).all() or not np.isfinite(found.sigma).all():
            raise DeviceError(f"{failed}: results that are not numbers")
        near = np.abs(found.depth - self._depth) <= NOISE * self._depth
        worst = float(min(near.mean(), (found.state == self._state).mean()))
        if worst < MIN_AGREEING:
            raise DeviceError(f"{failed}: only {100 * worst:.1f} % of its depths are right")


def frames_per_s(device: ComputeDevice, seconds: Callable[[], float]) -> float:
    """Throughput for images of 640 x 480 at every second pixel, over 2 s."""
    it = scene(*SPEED_SIZE)
    height, width = it.images[0].shape
    engine = DepthEngine(device, width, height, it.intrinsics, DepthConfig(), eager=False)
    reconstruct(engine, it)  # warm-up: kernels are compiled
    begun, n = seconds(), 0
    while seconds() - begun < SPEED_S:
        reconstruct(engine, it)
        n += len(it.images)
    return n / (seconds() - begun)
