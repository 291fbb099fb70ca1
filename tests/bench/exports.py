"""Mesh and orthomosaics of flights with ground truth; the tables of results.md.

    python -m tests.bench.exports FLIGHT RUN

RUN is the --out of a replay of FLIGHT. Both are aligned by the best similarity of their paths.
Mesh: points drawn evenly from its triangles, and those of the cloud, against the true surface; what
is found of this is by the distance to the triangles, and to the points of the cloud.
Points that no true depth image has within its borders are not judged: there the true surface is
not known. Their share is printed.
Orthomosaics: windows of 6 m against what the true images show when they are put on the true
surface by true poses; a shift is that of the best phase correlation.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import KDTree

from companion.app.run_pictures import pictures_of
from companion.config import CameraConfig, Config
from companion.messages import Frame
from companion.products.export.image_mosaic import image_mosaic
from companion.products.export.map_frame import map_frame
from companion.products.export.mesh import mesh_of
from companion.products.export.surface import surface_of
from companion.products.run_folder import FinishedRun, read_run
from drivers.open_flight import open_flight
from tests.bench import cloud as cloud_bench
from tests.support.reference.scoring import (
    Alignment,
    Array,
    Trajectory,
    read_lens,
    read_tum,
    score,
    true_depths,
)

NEAR_M, FOUND_M = 0.15, 0.5
N_DRAWN = 200_000
N_TRIANGLES = 6
WINDOW_M = 6.0
LEAST_KNOWN = 0.95
LEAST_RESPONSE = 0.2


def mesh_line(
    flight: Path, run: FinishedRun, truth: Trajectory, alignment: Alignment, surface: Array
) -> str:
    began_s = time.monotonic()
    mesh = mesh_of(run.cloud)
    took_s = time.monotonic() - began_s
    memory_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    made = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    on_mesh, _ = trimesh.sample.sample_surface(made, N_DRAWN, seed=0)
    true, looked_up = KDTree(surface), cloud_bench.drawn(surface)
    shares, judged_share = [], []
    for points, corners in (
        (np.asarray(on_mesh), alignment(mesh.vertices)[mesh.faces]),
        (run.cloud.points.astype(np.float64), None),
    ):
        aligned = alignment(points)
        some = cloud_bench.drawn(aligned)
        judged = in_true_images(some, flight, truth)
        off_m, _ = true.query(some[judged], workers=-1)
        if corners is None:
            to_it_m, _ = KDTree(aligned).query(looked_up, workers=-1)
        else:
            to_it_m = to_triangles(looked_up, corners)
        shares += [np.mean(off_m < NEAR_M), np.mean(to_it_m < FOUND_M)]
        judged_share.append(f"{100 * judged.mean():.1f} %")
    near, found, cloud_near, cloud_found = (f"{100 * share:.1f} %" for share in shares)
    return (
        f"mesh: cells {mesh.cell:g} m, {len(mesh.faces)} triangles, {took_s:.0f} s, "
        f"{memory_gb:.2f} GB; within {NEAR_M} m {near}, surface found within {FOUND_M} m {found}; "
        f"the cloud {cloud_near} and {cloud_found}; "
        f"judged {' and '.join(judged_share)} of the points"
    )


def to_triangles(points: Array, corners: Array) -> Array:
    """Distances (N,) of points (N, 3) to the nearest of small triangles (F, 3, 3).

    Of those with the nearest centres: the nearest triangle of all may not be among them, which
    makes a distance too large by less than a side. Points drawn from the triangles would make it
    larger by how far apart they lie.
    """
    _, near = KDTree(corners.mean(1)).query(points, k=N_TRIANGLES, workers=-1)
    closest_point: Any = trimesh.triangles.closest_point
    nearest = [closest_point(corners[column], points) - points for column in near.T]
    return np.asarray(np.linalg.norm(nearest, axis=2).min(0))


def in_true_images(points: Array, flight: Path, truth: Trajectory) -> NDArray[np.bool_]:
    """Which points (N, 3) of the true world lie within the borders of a true depth image."""
    matrix, lens = read_lens(flight)
    there = np.zeros(len(points), bool)
    for index, depth_m in true_depths(flight):
        seen = (points - truth.centres[index]) @ truth.rotations[index]
        # wider than any of the lenses: beyond it a distortion may fold back into the image
        ahead = np.flatnonzero((seen[:, 2] > 0.1) & (np.abs(seen[:, :2]) < seen[:, 2:]).all(1))
        if not len(ahead):
            continue
        pixels, _ = cv2.projectPoints(seen[ahead], np.zeros(3), np.zeros(3), matrix, lens)
        u, v = np.asarray(pixels)[:, 0].T
        inside = (u >= -0.5) & (u < depth_m.shape[1] - 0.5)
        inside &= (v >= -0.5) & (v < depth_m.shape[0] - 0.5)
        there[ahead[inside]] = True
    return there


def true_places(
    flight: Path, run: FinishedRun, truth: Trajectory, alignment: Alignment
) -> tuple[Array, Array]:
    """Places (N, 3) in the run's world and grey values (N,) of all pixels with true depth."""
    opened = open_flight(flight, CameraConfig())
    camera = opened.camera
    depths = {int(p.stem): p for p in sorted((flight / "truth" / "depth").glob("*.png"))}
    places, greys = [], []
    frames = (frame for frame in opened.frames() if isinstance(frame, Frame))
    for at, frame in enumerate(frames):
        if at not in depths:
            continue
        depth = np.asarray(cv2.imread(str(depths[at]), cv2.IMREAD_UNCHANGED), np.float64) * 0.005
        v, u = np.nonzero(depth)
        rays = camera.normalise(np.stack([u, v], 1).astype(np.float64))
        seen = np.c_[rays, np.ones(len(rays))] * depth[v, u, None]
        there = seen @ truth.rotations[at].T + truth.centres[at]
        places.append((there - alignment.translation) @ alignment.rotation / alignment.scale)
        greys.append(frame.grey[v, u].astype(np.float64))
    return np.concatenate(places), np.concatenate(greys)


def mosaic_lines(flight: Path, run: FinishedRun, truth: Trajectory, aligned: Alignment) -> str:
    frame = map_frame(run.origin, run.metric, 0)
    surface = surface_of(run.cloud, frame, 0.0)
    began_s = time.monotonic()
    mosaic = image_mosaic(pictures_of(run, flight, Config()), surface, frame)
    took_s = time.monotonic() - began_s
    shape, cell = mosaic.seen.shape, mosaic.cell_m
    places, values = true_places(flight, run, truth, aligned)
    east, north, up = frame.coordinates(places).T
    column = ((east - mosaic.west) / cell).astype(int)
    row = ((mosaic.north - north) / cell).astype(int)
    inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
    order = np.argsort(up[inside], kind="stable")  # the highest is seen from above
    true = np.full(shape, np.nan)
    true[row[inside][order], column[inside][order]] = values[inside][order]
    of_cloud = cv2.resize(surface.rgb, shape[::-1], interpolation=cv2.INTER_LINEAR)
    known = cv2.resize(np.isfinite(surface.height).astype(np.float32), shape[::-1]) > 0.5
    out = [
        f"mosaic: {mosaic.n_pictures} pictures, cells {cell:.3f} m, {took_s:.0f} s",
        compared("of the pictures", mosaic.rgb, mosaic.seen, true, cell),
        compared("of the cloud", np.asarray(of_cloud, np.uint8), known, true, cell),
    ]
    return "\n".join(out)


def compared(what: str, rgb: NDArray[Any], seen: NDArray[Any], true: Array, cell: float) -> str:
    """Shifts and differences of windows."""
    grey = cv2.cvtColor(np.ascontiguousarray(rgb, np.uint8), cv2.COLOR_RGB2GRAY).astype(np.float64)
    side = round(WINDOW_M / cell)
    shifts, differences, detail = [], [], []
    window = cv2.createHanningWindow((side, side), cv2.CV_64F)
    for top in range(0, len(grey) - side, side // 2):
        for left in range(0, grey.shape[1] - side, side // 2):
            part = np.s_[top : top + side, left : left + side]
            good = np.isfinite(true[part]) & seen[part].astype(bool)
            if good.mean() < LEAST_KNOWN:
                continue
            a, b = (np.where(good, x[part], np.mean(x[part][good])) for x in (grey, true))
            a, b = a - a.mean(), b - b.mean()
            (du, dv), response = cv2.phaseCorrelate(a, b, window)
            if response > LEAST_RESPONSE:
                shifts.append(np.hypot(du, dv) * cell)
            differences.append(np.sqrt(np.mean((a - b)[good] ** 2)))
            detail.append(np.std(np.diff(a, axis=1)) / max(np.std(np.diff(b, axis=1)), 1e-6))
    if not shifts:
        return f"  {what}: no window can be compared"
    return (
        f"  {what}: {len(shifts)} of {len(differences)} windows matched, off by "
        f"{np.median(shifts):.3f} m (median), {np.quantile(shifts, 0.95):.3f} m (95 %); "
        f"grey values {np.median(differences):.1f} apart (RMS), detail {np.median(detail):.2f} of 1"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("flight", type=Path)
    parser.add_argument("run", type=Path)
    options = parser.parse_args()
    run = read_run(options.run)
    truth = read_tum(options.flight / "truth" / "world_from_camera.tum")
    alignment = score(read_tum(options.run / "trajectory.tum"), truth).alignment
    cloud_bench.EVERY_PIXEL = 1  # 0.15 m is as far as one third of the pixels lie apart
    surface, _ = cloud_bench.true_surface(options.flight, truth)
    print(mesh_line(options.flight, run, truth, alignment, surface), flush=True)
    print(mosaic_lines(options.flight, run, truth, alignment))


if __name__ == "__main__":
    main()
