"""Accuracy and completeness of the cloud on flights with ground truth; the table of results.md.

    python -m tests.bench.cloud FLIGHT... [--set SECTION.KEY=VALUE ...]

Each flight is replayed as its users do, in lockstep. Its path is aligned to the true one by the
best similarity, and the cloud with it. A point is within 2 % where the nearest point of the true
surface is not further than 2 % of the distance from which that was seen; a point of the surface is
found where the cloud has one within 0.5 m. Frames a second are those of the whole command.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import KDTree

from tests.support.reference.scoring import (
    Array,
    Trajectory,
    read_lens,
    read_ply,
    read_tum,
    score,
    true_depths,
)

EVERY_PIXEL = 3
"""Of the true depth images, in both directions: 0.02 m on the ground from 5 m."""
MOST_POINTS = 200_000
"""Of cloud and surface that are looked up, drawn at random: shares within 0.1 %."""
NEAR, FOUND_M = 0.02, 0.5


def true_surface(flight: Path, truth: Trajectory) -> tuple[Array, Array]:
    """Points (N, 3) of the true surface in the true world, and their distances to the camera."""
    matrix, lens = read_lens(flight)
    points, ranges_m = [], []
    for at, whole_m in true_depths(flight):
        depth_m = whole_m[::EVERY_PIXEL, ::EVERY_PIXEL]
        v, u = np.nonzero(depth_m)
        if not len(v):
            continue  # the sky, or a camera inside of a house
        pixels = np.stack([u, v], 1)[:, None].astype(np.float64) * EVERY_PIXEL
        rays = np.asarray(cv2.undistortPoints(pixels, matrix, lens), np.float64)[:, 0]
        seen = np.c_[rays, np.ones(len(rays))] * depth_m[v, u, None]
        points.append(seen @ truth.rotations[at].T + truth.centres[at])
        ranges_m.append(np.linalg.norm(seen, axis=1))
    return np.concatenate(points), np.concatenate(ranges_m)


def drawn(points: Array) -> Array:
    """At most MOST_POINTS of them."""
    some: Array = np.random.default_rng(0).permutation(points)[:MOST_POINTS]
    return some


def row(flight: Path, settings: list[str]) -> str:
    """A line of the table."""
    with tempfile.TemporaryDirectory() as folder:
        out, began_s = Path(folder) / "out", time.monotonic()
        command = [sys.executable, "-m", "companion", "replay", str(flight), "--out", str(out)]
        process = subprocess.Popen([*command, *(f"--set={each}" for each in settings)])
        _, status, usage = os.wait4(process.pid, 0)
        took_s = time.monotonic() - began_s
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise SystemExit(f"{flight}: the replay ended with {process.returncode}")
        truth = read_tum(flight / "truth" / "world_from_camera.tum")
        scored = score(read_tum(out / "trajectory.tum"), truth)
        vertices = read_ply(out / "cloud.ply")
    cloud = scored.alignment(np.stack([vertices[axis] for axis in "xyz"], 1).astype(np.float64))
    surface, ranges_m = true_surface(flight, truth)
    off_m, nearest = KDTree(surface).query(drawn(cloud), workers=-1)
    to_cloud_m, _ = KDTree(cloud).query(drawn(surface), workers=-1)
    near = np.mean(off_m < NEAR * ranges_m[nearest])
    return (
        f"| {flight.name} | {100 * scored.tracked_share:.1f} % | {scored.ate_sim3_m:.3f} m "
        f"| {100 * scored.scale_error:.2f} % | {100 * near:.1f} % "
        f"| {100 * np.mean(to_cloud_m < FOUND_M):.1f} % | {len(truth.t_s) / took_s:.1f} "
        f"| {usage.ru_maxrss / 2**20:.2f} GB |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("flight", nargs="+", type=Path)
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    options = parser.parse_args()
    print(
        "| flight | frames tracked | ATE, RMSE | scale error | cloud within 2 % of range "
        "| surface found within 0.5 m | frames/s | memory |\n" + "|---" * 8 + "|"
    )
    for flight in options.flight:
        print(row(flight, options.set), flush=True)


if __name__ == "__main__":
    main()
