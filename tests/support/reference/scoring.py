"""How well a replay's results agree with a flight's truth."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

DEPTH_UNIT_M = 0.005
"""Of the true depth images of rendered flights."""


@dataclass(frozen=True)
class Trajectory:
    """`t_s` (N,); `centres` (N, 3); `rotations` (N, 3, 3), world from camera."""

    t_s: Array
    centres: Array
    rotations: Array


@dataclass(frozen=True)
class Alignment:
    """The similarity that takes `a` to `b` with the least squared error (Umeyama 1991)."""

    scale: float
    rotation: Array
    translation: Array

    def __call__(self, points: Array) -> Array:
        moved: Array = self.scale * points @ self.rotation.T + self.translation
        return moved


@dataclass(frozen=True)
class Score:
    """Of the frames that both trajectories have."""

    n_common: int
    tracked_share: float
    ate_sim3_m: float
    scale_error: float
    alignment: Alignment


def read_tum(path: Path) -> Trajectory:
    rows = np.loadtxt(path, comments="#", ndmin=2)
    rotations = Rotation.from_quat(rows[:, 4:]).as_matrix()
    return Trajectory(rows[:, 0], rows[:, 1:4], rotations)


def align(a: Array, b: Array) -> Alignment:
    """`b` of `a`, both (N, 3)."""
    mean_a, mean_b = a.mean(0), b.mean(0)
    u, singular, vt = np.linalg.svd((b - mean_b).T @ (a - mean_a) / len(a))
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * flip) @ vt
    scale = float((singular * flip).sum() / ((a - mean_a) ** 2).sum(1).mean())
    return Alignment(scale, rotation, mean_b - scale * rotation @ mean_a)


def score(run: Trajectory, truth: Trajectory) -> Score:
    """Frames are the same where their times are within a millisecond."""
    nearest = np.abs(run.t_s[:, None] - truth.t_s[None]).argmin(1)
    same = np.abs(run.t_s - truth.t_s[nearest]) < 1e-3
    found, wanted = run.centres[same], truth.centres[nearest[same]]
    alignment = align(found, wanted)
    error = np.linalg.norm(alignment(found) - wanted, axis=1)
    return Score(
        n_common=int(same.sum()),
        tracked_share=len(np.unique(nearest[same])) / len(truth.t_s),
        ate_sim3_m=float(np.sqrt((error**2).mean())),
        scale_error=abs(1 / alignment.scale - 1),
        alignment=alignment,
    )


def read_ply(path: Path) -> NDArray[np.void]:
    """Vertices as a structured array, by somebody else's reader."""
    # mapped it is read as one array; read from a stream it would be vertex by vertex, 4 s a cloud
    return np.array(PlyData.read(path)["vertex"].data)


def read_lens(flight: Path) -> tuple[Array, Array]:
    """A flight's camera matrix (3, 3) and its distortion `k1 k2 p1 p2 k3`, as OpenCV has them."""
    camera = json.loads((flight / "camera.json").read_text())
    matrix = np.array(
        [[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1.0]]
    )
    return matrix, np.array([camera[name] for name in ("k1", "k2", "p1", "p2", "k3")])


def true_depths(flight: Path) -> Iterator[tuple[int, Array]]:
    """Frame number and true depth (H, W) along z of the distorted image, metres, 0 for none."""
    for path in sorted((flight / "truth" / "depth").glob("*.png")):
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert image is not None, path
        yield int(path.stem), np.asarray(image, np.float64) * DEPTH_UNIT_M


def depth_errors(points: Array, flight: Path, truth: Trajectory) -> Array:
    """How far points (N, 3) in the true world lie off the truth depth images, as share of depth.

    A point counts in every image that has it and that has a truth depth there.
    """
    matrix, lens = read_lens(flight)
    errors = []
    for index, depth_m in true_depths(flight):
        p = (points - truth.centres[index]) @ truth.rotations[index]
        p = p[(p[:, 2] > 0.1) & (np.abs(p[:, :2]) < p[:, 2:]).all(1)]
        if not len(p):
            continue
        pixels, _ = cv2.projectPoints(p, np.zeros(3), np.zeros(3), matrix, lens)
        u, v = np.rint(np.asarray(pixels)[:, 0]).astype(int).T
        inside = (u >= 0) & (u < depth_m.shape[1]) & (v >= 0) & (v < depth_m.shape[0])
        wanted_m = depth_m[v[inside], u[inside]]
        errors.append(np.abs(p[inside, 2] / np.maximum(wanted_m, 1e-9) - 1)[wanted_m > 0])
    return np.concatenate(errors)
