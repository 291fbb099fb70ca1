"""Depths of a stereo pair: corners of the first image found in the second along epipolar lines."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.errors import FlightError
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose
from companion.messages import Bytes, Floats

Bools = NDArray[np.bool_]
N_CORNERS, CORNER_SPACING_PX, CORNER_QUALITY = 160, 8, 0.02
HALF_PX = 7
"""Half the side of a patch."""
LEAST_DISPARITY_PX, MOST_DISPARITY_RATIO = 4.0, 0.3
"""Nearer than a few baselines the two see too different pictures; the most is of the width."""
LEAST_CORRELATION, UNIQUE_BY = 0.85, 0.05
SIGMA_DISPARITY_PX = 0.2
MAX_THERE_AND_BACK_PX = 0.5
MAX_OFF_LINE_PX = 1.5
"""Off the epipolar line: the match is another thing, or the calibration is wrong."""
MOST_OFF_AXIS = 1.5
"""Tangent of the largest angle from the common axis that is looked at."""
LEAST_COMMON_COSINE = 0.5
"""Of the angle between the two optical axes."""
MIN_OFF_LINE = 8


class Depths(NamedTuple):
    """N depths: pixels (N, 2) of the first image, metres along its axis (N,), deviations (N,)."""

    pixels: Array
    depth_m: Array
    sigma_m: Array
    off_line_px: float
    """Median of distances from matches to their epipolar lines; nan of few."""


class StereoPair:
    """Two cameras of one clock, by their mounts on the same body.

    Both images are turned to a common plane whose rows are epipolar lines (Fusiello, Trucco and
    Verri 2000). FlightError where the mounts are not known or the cameras see different things.
    """

    def __init__(self, first: Camera, second: Camera) -> None:
        if first.body_from_camera is None or second.body_from_camera is None:
            raise FlightError("a stereo pair needs the mount of both cameras")
        first_from_second = first.camera_from_body @ second.body_from_camera
        base = first_from_second.translation
        self.baseline_m = float(np.linalg.norm(base))
        axes = [np.array([0.0, 0.0, 1.0]), first_from_second.rotation[:, 2]]
        if self.baseline_m <= 0 or axes[0] @ axes[1] < LEAST_COMMON_COSINE:
            raise FlightError("the two cameras do not look at the same things from two places")
        x = base / self.baseline_m
        z = axes[0] + axes[1]
        z = z - (z @ x) * x
        if np.linalg.norm(z) < LEAST_COMMON_COSINE:
            raise FlightError("one camera is behind the other: it measures no depth")
        z /= np.linalg.norm(z)
        self._first = first
        self._first_from_plane = np.stack([x, np.cross(z, x), z], 1)
        self._focal_px = first.focal_px
        turned = Pose(self._first_from_plane, np.zeros(3))
        edge = np.clip(_edge_rays(first) @ turned.rotation, -1e9, 1e9)
        reach = np.clip(edge[:, :2] / np.maximum(edge[:, 2:], 1e-3), -MOST_OFF_AXIS, MOST_OFF_AXIS)
        low = np.floor(reach.min(0) * self._focal_px)
        self._width, self._height = (
            int(n) for n in np.ceil(reach.max(0) * self._focal_px - low) + 1
        )
        self._centre = -low
        second_from_plane = first_from_second.rotation.T @ self._first_from_plane
        self._maps = (
            self._map_of(first, self._first_from_plane),
            self._map_of(second, second_from_plane),
        )

    def _map_of(self, camera: Camera, camera_from_plane: Array) -> tuple[Array, Array]:
        u, v = np.meshgrid(np.arange(self._width), np.arange(self._height))
        pixels = np.stack([u, v], -1).reshape(-1, 2).astype(np.float64)
        rays = self._rays(pixels) @ camera_from_plane.T
        px = np.nan_to_num(camera.project(rays), nan=-1e4).reshape(self._height, self._width, 2)
        return px[..., 0].astype(np.float32), px[..., 1].astype(np.float32)

    def _rays(self, pixels: Array) -> Array:
        flat = (pixels - self._centre) / self._focal_px
        return np.concatenate([flat, np.ones((len(flat), 1))], 1)

    def depths(self, first: Bytes, second: Bytes) -> Depths:
        """Depths of corners of the first grey image (H, W), by the second of the same exposure."""
        a, b = (
            np.asarray(cv2.remap(grey, *each, cv2.INTER_LINEAR), np.uint8)
            for grey, each in zip((first, second), self._maps, strict=True)
        )
        guessed = [(p, x) for p in corners_of(a) if (x := self._along_row(a, b, p)) is not None]
        if not guessed:
            return Depths(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.nan)
        here = np.array([p for p, _ in guessed], np.float32)
        guess = np.array([(x, p[1]) for p, x in guessed], np.float32)
        there, back, found = _refined(a, b, here, guess)
        off_line = there[:, 1] - here[:, 1]
        disparity = (here - there)[:, 0].astype(np.float64)
        ok = (
            found
            & (np.linalg.norm(back - here, axis=1) < MAX_THERE_AND_BACK_PX)
            & (np.abs(off_line) < MAX_OFF_LINE_PX)
            & (disparity >= LEAST_DISPARITY_PX)
        )
        z = self._focal_px * self.baseline_m / disparity[ok]
        points = z[:, None] * self._rays(here[ok].astype(np.float64)) @ self._first_from_plane.T
        off = np.abs(off_line[found])
        return Depths(
            self._first.project(points), points[:, 2],
            points[:, 2] * SIGMA_DISPARITY_PX / disparity[ok],
            float(np.median(off)) if len(off) >= MIN_OFF_LINE else float("nan"),
        )  # fmt: skip

    def _along_row(self, a: Bytes, b: Bytes, corner: Floats) -> float | None:
        """Column in the second image where a corner's patch is, to a pixel; None if unclear."""
        u, v = (round(float(c)) for c in corner)
        h = HALF_PX
        if not (h <= u < self._width - h and h <= v < self._height - h):
            return None
        first = max(0, u - int(MOST_DISPARITY_RATIO * self._width) - h)
        strip = b[v - h : v + h + 1, first : u + h + 1]
        if strip.shape[1] < 4 * h:
            return None
        patch = a[v - h : v + h + 1, u - h : u + h + 1]
        score = cv2.matchTemplate(strip, patch, cv2.TM_CCOEFF_NORMED)[0]
        best = int(score.argmax())
        rest = np.concatenate([score[: max(best - h // 2, 0)], score[best + h // 2 + 1 :]])
        if score[best] < LEAST_CORRELATION or score[best] - rest.max(initial=-1.0) < UNIQUE_BY:
            return None
        return float(first + best + h + corner[0] - u)


def corners_of(grey: Bytes) -> Floats:
    """The best corners (N, 2) of a picture (H, W), spread over it."""
    found = cv2.goodFeaturesToTrack(grey, N_CORNERS, CORNER_QUALITY, CORNER_SPACING_PX)
    return np.asarray([] if found is None else found, np.float32).reshape(-1, 2)


def _refined(a: Bytes, b: Bytes, here: Floats, guess: Floats) -> tuple[Floats, Floats, Bools]:
    """Places in the second image to a fraction of a pixel, and from there back in the first."""
    there, forth_ok = _moved(a, b, here, guess)
    back, back_ok = _moved(b, a, there, here)
    return there, back, forth_ok & back_ok


def _moved(a: Bytes, b: Bytes, here: Floats, guess: Floats) -> tuple[Floats, Bools]:
    """Patches about pixels (N, 2) of one image in another, near a guess (Lucas and Kanade 1981)."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        a, b, here, guess.copy(), winSize=(2 * HALF_PX + 1, 2 * HALF_PX + 1), maxLevel=0,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return np.asarray(there, np.float32), np.asarray(found).ravel() > 0


def _edge_rays(camera: Camera) -> Array:
    """Rays (N, 3) of pixels along the edge of the image, without those that have none."""
    u, v = np.linspace(0, camera.width - 1, 33), np.linspace(0, camera.height - 1, 33)
    right, bottom = np.full(33, u[-1]), np.full(33, v[-1])
    edge = np.r_[np.c_[u, 0 * u], np.c_[u, bottom], np.c_[0 * v, v], np.c_[right, v]]
    flat = camera.normalise(edge)
    flat = flat[np.isfinite(flat).all(1)]
    return np.concatenate([flat, np.ones((len(flat), 1))], 1)
