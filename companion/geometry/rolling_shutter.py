"""Rolling shutter: the motion of the camera while its rows are read out, undone in the image.

Row v of an image of H rows is exposed (v - (H - 1) / 2) / (H - 1) of the readout after the middle
row, whose time the stamp is. By then the camera has turned by its angular rate times that time, and
moved by its velocity times that time, so that a ray of the middle row's camera is seen elsewhere:
by the rotation alike at all depths, by the way according to depth, for which a plane through the
scene is enough. The shift is smooth over the image: it is computed on a coarse grid and
interpolated between.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

CELL_PX = 16
"""Cell of the grid. The shift is nearly bilinear in row and column: at 150 degrees/s and 25 ms it
is interpolated within 0.02 px."""
ROUNDS = 4
"""Of the row in which a ray is seen, which depends on the shift: each gains a digit or more, as the
shift changes little from row to row."""
LEAST_SHIFT_PX = 0.1
"""Images in which nothing is shifted by more are left as they are: interpolation would blur them
for less than what corners are located to."""


class RowTimes:
    """Times of the rows of one camera, relative to the stamp of its images."""

    def __init__(self, camera: Camera, readout_s: float) -> None:
        self._camera = camera
        self._middle = 0.5 * (camera.height - 1)
        self._s_per_row = readout_s / max(camera.height - 1, 1)

    def of_rows(self, rows: NDArray[Any]) -> Array:
        """Times (N,) of rows (N,), s."""
        out: Array = (np.asarray(rows, np.float64) - self._middle) * self._s_per_row
        return out

    def seen_at(self, normalised: Array, motion: Array) -> Array:
        """Distorted pixels (N, 2) at which rays (N, 2) of the middle row's camera are seen.

        `motion` (3, 3) is that of the camera, see `shutter_motion`. nan where a ray is not seen.
        """
        rates_rad_s, velocity, plane = motion
        rays = np.column_stack([normalised, np.ones(len(normalised))])
        # in the sky a plane would lie behind the camera
        moved = -np.maximum(rays @ plane, 0.0)[:, None] * velocity
        pixels = self._camera.project(rays)
        for _ in range(ROUNDS):
            t_s = self.of_rows(pixels[:, 1])
            # the world turns the other way
            turned = _turned(rays + t_s[:, None] * moved, -rates_rad_s, t_s)
            pixels = self._camera.project(turned)
        return pixels


def shutter_motion(
    rates_rad_s: Array, velocity: Array | None = None, plane: Array | None = None
) -> Array:
    """Motion (3, 3) of a camera while it is read out, in its axes.

    Its rows are the angular rate (3,) in rad/s, the velocity (3,), and a plane that is about the
    scene: the depth of a ray (x, y, 1) is one over its product with the plane (3,), in the unit of
    length of the velocity. Without both the camera only turns.
    """
    none = np.zeros(3)
    if velocity is None or plane is None:
        return np.stack([rates_rad_s, none, none])
    return np.stack([rates_rad_s, velocity, plane])


def nodes(width: int, height: int) -> Array:
    """Pixels (N, 2) of the nodes of an image's grid: centres of cells, with one cell around it."""
    u, v = ((np.arange(_n_nodes(size)) - 0.5) * CELL_PX - 0.5 for size in (width, height))
    return np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)


class Unrolling:
    """Remaps images of a rolling shutter to what a global one would have taken at their stamps.

    The image that is wanted has at its grid's nodes the rays `node_rays` (N, 2), see `nodes`, and
    comes from columns and rows `maps` (H, W) of a still camera's; by default it is distorted alike.
    """

    def __init__(
        self, camera: Camera, readout_s: float, node_rays: Array | None = None,
        maps: tuple[Floats, Floats] | None = None,
    ) -> None:  # fmt: skip
        self._camera = camera
        height, width = self._shape = camera.height, camera.width
        self._rows = RowTimes(camera, readout_s)
        self._rays = camera.normalise(nodes(width, height)) if node_rays is None else node_rays
        self._still = self._rows.seen_at(self._rays, np.zeros((3, 3)))
        if maps is None:
            u, v = np.meshgrid(np.arange(width), np.arange(height))
            maps = u.astype(np.float32), v.astype(np.float32)
        self._maps = maps
        self._is_distorted_alike = node_rays is None

    def image(self, image: Bytes, motion: Array) -> Bytes:
        """The image (H, W) or (H, W, 3) of a camera with a `motion`, see `shutter_motion`."""
        shift = np.nan_to_num(self._rows.seen_at(self._rays, motion) - self._still)
        if self._is_distorted_alike and np.abs(shift).max(initial=0.0) < LEAST_SHIFT_PX:
            return image
        columns, lines = (
            still + moved for still, moved in zip(self._maps, self._fine(shift), strict=True)
        )
        unrolled = cv2.remap(
            image, columns, lines, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(unrolled, np.uint8)

    def seen(self, pixels: NDArray[Any], motion: Array) -> Floats:
        """Pixels (N, 2) of the image that was read out, of those of one distorted alike.

        Unchanged where a pixel has no ray.
        """
        found = self._rows.seen_at(self._camera.normalise(pixels), motion)
        return np.asarray(np.where(np.isfinite(found), found, pixels), np.float32)

    def _fine(self, shift: Array) -> tuple[Floats, Floats]:
        """Shift of columns and of rows (H, W) from that at the nodes (N, 2)."""
        height, width = self._shape
        n_rows, n_columns = _n_nodes(height), _n_nodes(width)
        coarse = shift.reshape(n_rows, n_columns, 2).astype(np.float32)
        fine = cv2.resize(
            coarse, (n_columns * CELL_PX, n_rows * CELL_PX), interpolation=cv2.INTER_LINEAR
        )
        inside = fine[CELL_PX : CELL_PX + height, CELL_PX : CELL_PX + width]
        return np.asarray(inside[..., 0], np.float32), np.asarray(inside[..., 1], np.float32)


def _n_nodes(size: int) -> int:
    return -(-size // CELL_PX) + 2


def _turned(rays: Array, rates_rad_s: Array, t_s: Array) -> Array:
    """Rays (N, 3) turned at a rate (3,) for `t_s` (N,), by Rodrigues' formula."""
    rate = float(np.linalg.norm(rates_rad_s))
    if rate == 0.0:
        return rays
    axis, angle = rates_rad_s / rate, rate * t_s[:, None]
    along = (rays @ axis)[:, None] * axis
    out: Array = np.cos(angle) * (rays - along) + np.sin(angle) * np.cross(axis, rays) + along
    return out
