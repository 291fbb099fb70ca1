"""An hour of points through the cloud's store: peak memory, disk, and time at the end.

    python -m tests.bench.long_cloud [--keyframes N] [--points N] [--memory-mb N]

A drone flies along and sees the ground from 20 m: every keyframe has points at a tenth of a metre,
most of which the next keyframes have again. Prints a table, and what was written.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from companion.geometry.transforms import Pose, Similarity
from companion.messages import Floats, Georeference, MapUpdate, PointChunk
from companion.products.atomic_file import write_atomically
from companion.products.cloud_ply import ply_parts
from companion.products.flight_result import FlightResult

DOWN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
HEIGHT_M = 20.0
ROW_M, ROW_STEP_M = 400.0, 12.0


def place(k: int, step_m: float) -> Pose:
    """World from camera: there and back over a field, looking down."""
    row, along = divmod(k * step_m, ROW_M)
    north = along if int(row) % 2 == 0 else ROW_M - along
    return Pose(DOWN, np.array([north, ROW_STEP_M * row, -HEIGHT_M]))


def chunk(k: int, n: int, rng: np.random.Generator) -> PointChunk:
    """Points of the ground below, 24 m by 18 m."""
    points = np.column_stack(
        [rng.uniform(-12, 12, n), rng.uniform(-9, 9, n), HEIGHT_M + rng.normal(0, 0.03, n)]
    ).astype(np.float32)
    facing: Floats = np.tile(np.array([0, 0, -1], np.float32), (n, 1))
    sure = rng.uniform(0, 1, n).astype(np.float32)
    return PointChunk(
        k, k * 1_000_000_000, points, rng.integers(0, 255, (n, 3), np.uint8), sure, facing,
        (0.05 * (1 - sure)).astype(np.float32),
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--keyframes", type=int, default=3600)
    parser.add_argument("--points", type=int, default=2800)
    parser.add_argument("--memory-mb", type=float, default=64)
    parser.add_argument("--step-m", type=float, default=3.0)
    wanted = parser.parse_args()
    rng = np.random.default_rng(1)
    process = psutil.Process()

    def mb() -> float:
        return float(process.memory_info().rss / 1e6)

    with tempfile.TemporaryDirectory(dir=os.environ.get("TMPDIR", ".")) as name:
        result = FlightResult(Path(name), wanted.memory_mb)
        before = mb()
        print("| keyframes | points | memory, MB more | on disk, MB |\n|---|---|---|---|")
        for k in range(wanted.keyframes):
            result.take(chunk(k, wanted.points, rng))
            if (k + 1) % max(wanted.keyframes // 6, 1) == 0:
                row = (k + 1, result.n_points, mb() - before, result._chunks._end / 1e6)
                print("| {} | {} | {:.0f} | {:.0f} |".format(*row), flush=True)
        poses = {k: place(k, wanted.step_m) for k in range(wanted.keyframes)}
        metric = Georeference(Similarity.identity(), 0.01, 0.01, "made up", 9, 0.1)
        result.take(MapUpdate(1, 0, poses, np.zeros((0, 3)), metric))
        begun_s = time.process_time()
        cloud = result.cloud(0.1)
        write_atomically(Path(name) / "cloud.ply", ply_parts(cloud, "m", None))
        spent_s = time.process_time() - begun_s
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6 - before
        size_mb = (Path(name) / "cloud.ply").stat().st_size / 1e6
        result.close()
        print(
            f"\n{len(cloud)} points in {size_mb:.0f} MB of cloud.ply after {spent_s:.0f} s of "
            f"processor time; at most {peak_mb:.0f} MB more than before, "
            f"{1e6 * peak_mb / max(len(cloud), 1):.0f} bytes per point of the cloud"
        )


if __name__ == "__main__":
    main()
