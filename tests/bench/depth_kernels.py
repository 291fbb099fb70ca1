"""Processor time of a keyframe's dense depth, by kernel; the table of dense_depth.md.

    python -m tests.bench.depth_kernels [--stride 2] [--rounds 20] [--against CLONE]

Ground 7 to 23 m away, seen at a slant by six views, 640x480, on the first device. CLONE is another
working tree, of an earlier version say: both are measured in turn. Times are those of all threads
of the process, each kernel waited for, and, in the line above them, without waiting.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from companion.config import DepthConfig
from companion.dense.engine import DepthEngine
from companion.dense.opencl import devices_of, open_device, platform_names
from companion.dense.view_selection import Intrinsics
from companion.geometry.transforms import Array, Pose
from companion.messages import Bytes
from tests.support.flights.scene import texture

SIZE, MARGIN = (640, 480), 160
FOCAL_PX = 500.0
NORMAL, DISTANCE_M = np.array([0.0, 0.94, 0.94]) / np.hypot(0.94, 0.94), 8.0
"""Of the ground: the points X in the camera with NORMAL X = DISTANCE_M."""
PLACES_M = ((0.8, 0.0), (-0.8, 0.2), (0.0, 0.9), (1.4, 0.5), (-1.3, -0.6), (0.3, -1.2))
NEAR_M, FAR_M = 5.0, 30.0


def views() -> tuple[Bytes, list[tuple[Bytes, Pose]]]:
    """The reference image, and others with their poses as seen from it."""
    big = texture(np.random.default_rng(1), 1024)
    lens: Array = np.array([[FOCAL_PX, 0, SIZE[0] / 2], [0, FOCAL_PX, SIZE[1] / 2], [0, 0, 1.0]])
    found = []
    for x, y in ((0.0, 0.0), *PLACES_M):
        pose = Pose(np.eye(3), np.array([-x, -y, 0.0]))
        moved = np.eye(3) + np.outer(pose.translation, NORMAL) / DISTANCE_M
        turned = lens @ moved @ np.linalg.inv(lens)
        shift = np.array([[1.0, 0, -MARGIN], [0, 1.0, -MARGIN], [0, 0, 1.0]])
        seen = cv2.warpPerspective(big, turned @ shift, SIZE)
        found.append((np.asarray(seen, np.uint8), pose))
    return found[0][0], found[1:]


def keyframe(engine: DepthEngine, reference: Bytes, others: list[tuple[Bytes, Pose]]) -> Array:
    """Depth of the reference (H, W), metres."""
    engine.begin(reference, NEAR_M, FAR_M)
    for grey, pose in others:
        engine.update(grey, pose)
    depth = engine.finish(0, 0, np.repeat(reference[..., None], 3, 2)).depth
    return np.asarray(depth, np.float64)


class WaitingEngine(DepthEngine):
    """A depth engine that waits for each kernel and adds up its processor time, seconds."""

    def __init__(self, *given: Any, **options: Any) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.launches: Counter[str] = Counter()
        super().__init__(*given, **options)

    def _run(self, name: str, *given: Any) -> None:
        self._device.queue.finish()
        begun = time.process_time()
        super()._run(name, *given)
        self._device.queue.finish()
        self.seconds[name] += time.process_time() - begun
        self.launches[name] += 1


def measure(stride: int, rounds: int) -> None:
    """Print the table of this working tree."""
    listed = [each for i in range(len(platform_names())) for each in devices_of(i)]
    device = open_device(listed[0])
    reference, others = views()
    camera = Intrinsics(FOCAL_PX, FOCAL_PX, SIZE[0] / 2, SIZE[1] / 2)
    rays = np.stack(np.meshgrid(np.arange(0, SIZE[0], stride), np.arange(0, SIZE[1], stride)), -1)
    across = (rays - (SIZE[0] / 2, SIZE[1] / 2)) @ NORMAL[:2] / FOCAL_PX + NORMAL[2]
    config = DepthConfig(stride=stride)
    engine, whole = DepthEngine(device, *SIZE, camera, config, eager=False), []
    for _ in range(rounds + 1):  # the first compiles
        begun = time.process_time()
        depth = keyframe(engine, reference, others)
        whole.append(time.process_time() - begun)
    right = float((np.abs(depth * across / DISTANCE_M - 1.0) < 0.02).mean())
    each = 1e3 * float(np.median(whole[1:]))
    print(f"{device.name}, stride {stride}: {each:.1f} ms, {100 * right:.1f} % within 2 %")
    engine = WaitingEngine(device, *SIZE, camera, config, eager=False)
    keyframe(engine, reference, others)
    engine.seconds.clear()
    engine.launches.clear()
    for _ in range(rounds):
        keyframe(engine, reference, others)
    for name, seconds in sorted(engine.seconds.items(), key=lambda each: -each[1]):
        n = engine.launches[name] // rounds
        print(f"  {name:20} {1e3 * seconds / rounds:6.2f} ms  {n:3} launches")


def main() -> None:
    """Measure this working tree, and another in turn if one is given."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--stride", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--against", type=Path)
    given = parser.parse_args()
    if given.against is None:
        measure(given.stride, given.rounds)
        return
    options = ["--stride", str(given.stride), "--rounds", str(given.rounds)]
    for tree in (given.against.resolve(), Path.cwd()):
        print(f"{tree}:", flush=True)
        environment = {**os.environ, "PYTHONPATH": str(tree)}
        subprocess.run([sys.executable, __file__, *options], env=environment, check=True)


if __name__ == "__main__":
    main()
