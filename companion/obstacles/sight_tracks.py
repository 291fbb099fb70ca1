"""Corners followed from image to image about the height of the vehicle, one in each small cell.

Depth of a keyframe comes a second or two late, and where all is far away keyframes are rare. These
corners are known in the newest image, and thin things have some of their own.

Lucas & Kanade 1981, there and back (Kalal et al. 2010, "Forward-backward error").
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array
from companion.messages import Bytes, Floats
from companion.obstacles.obstacle_sectors import ABOVE_M, BELOW_M

CELL_RAD = np.radians(1.0)
UP_RAD, DOWN_RAD = np.arctan([ABOVE_M / 3.0, BELOW_M / 3.0])
"""At 3 m the band of heights that is searched ends there."""
COARSE_PX = 16
"""Steps by which rows are looked for in which that band lies."""
WINDOW_PX, LEVELS = 9, 2
"""A larger window sees more of what is behind a thin thing than of the thing."""
MAX_RETURN_PX = 0.5
"""Distance from a corner to where it comes out when it is followed there and back."""
LEAST_CORNER = 1e-4
"""Smaller eigenvalue of the gradients about it, greys from 0 to 1: noise of 2 greys stays below."""
MARGIN_PX = 6
MOST_IMAGES = 16
"""Kept of each corner: at ten a second those of the last 1.6 s, in which a thing at 8 m comes a
fifth nearer at 1 m/s."""

Mask = NDArray[np.bool_]
NONE: Floats = np.zeros((0, 2), np.float32)


class SightTracks:
    """Corners of the newest image, and where they were in the ones before.

    `seen` (K, N, 2) are ideal normalised coordinates, the newest last, nan before a corner was
    first seen.
    """

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._last: Bytes | None = None
        self._is_due = True
        """New corners are looked for in every other image."""
        across, down = (
            np.arange(0, n + COARSE_PX, COARSE_PX) for n in (camera.width, camera.height)
        )
        self._coarse = self._rays(np.array(np.meshgrid(across, down), np.float32).reshape(2, -1).T)
        self._coarse_rows = down
        self._px: Floats = NONE
        self.seen: Array = np.zeros((0, 0, 2))

    def step(self, grey: Bytes, world_from_camera: Array, now_from_last: Array) -> None:
        """Follow all corners into the next image (H, W), and find new ones in empty cells.

        Rotations (3, 3): into a level world, for the cells, and from the camera of the last image.
        """
        band = self._band(world_from_camera)
        if self._last is not None and self._last.shape == grey.shape and band.stop > 0:
            self._follow(self._last, grey, now_from_last, band)
        else:
            self._px, self.seen = self._px[:0], self.seen[:, :0]
        self._last = grey
        columns, rows, level = self._cells(self._px, world_from_camera)
        n_images = (~np.isnan(self.seen[..., 0])).sum(0)
        order = np.argsort(-n_images, kind="stable")
        key = _key(columns, rows)
        _, first = np.unique(key[order], return_index=True)
        kept = order[first]
        kept = kept[level[kept]]
        self._px, before = self._px[kept], self.seen[:, kept]
        new = NONE
        if self._is_due and band.stop > 0:
            new = self._new(grey, world_from_camera, key[kept], band)
        self._is_due = not self._is_due
        unseen = np.full((len(before), len(new), 2), np.nan)
        self._px = np.concatenate([self._px, new])
        before = np.concatenate([before, unseen], 1)
        now = self._camera.normalise(self._px)
        self.seen = np.concatenate([before, now[None]])[-MOST_IMAGES:]

    def drop(self, which: Mask) -> None:
        """Follow some corners (N,) no longer, so that others are found in their cells."""
        self._px, self.seen = self._px[~which], self.seen[:, ~which]

    def _band(self, world_from_camera: Array) -> slice:
        """Rows of an image in which the band of heights lies; up to 0 where none."""
        up = _up_rad(self._coarse @ world_from_camera.T).reshape(len(self._coarse_rows), -1)
        inside = ((up <= UP_RAD) & (up >= -DOWN_RAD)).any(1)
        found = self._coarse_rows[inside]
        if len(found) == 0:
            return slice(0, 0)
        first, end = found[0] - COARSE_PX - MARGIN_PX, found[-1] + COARSE_PX + MARGIN_PX
        return slice(max(int(first), 0), int(end))

    def _follow(self, last: Bytes, grey: Bytes, now_from_last: Array, band: slice) -> None:
        start = self._px
        if len(start) == 0:
            return
        turned = self._rays(start) @ now_from_last.T
        guess = self._camera.project(turned).astype(np.float32)
        guess = np.where(np.isfinite(guess), guess, start)
        shift = np.array([0, band.start], np.float32)
        last, grey = last[band], grey[band]
        end, found = _followed(last, grey, start - shift, guess - shift, LEVELS)
        back, returned = _followed(grey, last, end, start - shift, 0)
        height, width = grey.shape
        ok = found & returned & (np.abs(back + shift - start).max(1) < MAX_RETURN_PX)
        ok &= (end >= MARGIN_PX).all(1) & (end < [width - MARGIN_PX, height - MARGIN_PX]).all(1)
        self._px, self.seen = (end + shift)[ok], self.seen[:, ok]

    def _new(
        self, grey: Bytes, world_from_camera: Array, taken: NDArray[np.int64], band: slice
    ) -> Floats:
        """The best corner (N, 2) of each cell that is not taken."""
        strength = cv2.cornerMinEigenVal(grey[band], 3)
        peak = strength >= np.maximum(cv2.dilate(strength, np.ones((5, 5), np.uint8)), LEAST_CORNER)
        peak[:MARGIN_PX] = peak[-MARGIN_PX:] = False
        peak[:, :MARGIN_PX] = peak[:, -MARGIN_PX:] = False
        v, u = np.nonzero(peak)
        corners = np.stack([u, v + band.start], 1).astype(np.float32)
        columns, rows, level = self._cells(corners, world_from_camera)
        order = np.argsort(-strength[v, u], kind="stable")
        order = order[level[order]]
        key, first = np.unique(_key(columns, rows)[order], return_index=True)
        return np.asarray(corners[order[first[~np.isin(key, taken)]]])

    def _rays(self, pixels: Floats) -> Array:
        rays: Array = np.c_[self._camera.normalise(pixels), np.ones(len(pixels))]
        return rays

    def _cells(
        self, pixels: Floats, world_from_camera: Array
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], Mask]:
        """Columns and rows of cells, and which pixels are near enough to level."""
        rays = self._rays(pixels) @ world_from_camera.T
        bearing = np.nan_to_num(np.arctan2(rays[:, 1], rays[:, 0]), nan=0.0)
        up = np.nan_to_num(_up_rad(rays), nan=np.pi)
        column, row = (np.floor(angle / CELL_RAD).astype(np.int64) for angle in (bearing, up))
        return column, row, (up <= UP_RAD) & (up >= -DOWN_RAD)


def _up_rad(rays: Array) -> Array:
    """Elevations (N,) of rays (N, 3) in a level world."""
    return np.asarray(np.arctan2(-rays[:, 2], np.hypot(rays[:, 0], rays[:, 1])))


def _key(columns: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.int64]:
    return 1000 * columns + rows


def _followed(
    last: Bytes, grey: Bytes, start: Floats, guess: Floats, levels: int
) -> tuple[Floats, Mask]:
    end, found, _ = cv2.calcOpticalFlowPyrLK(
        last, grey, start[:, None], guess[:, None].astype(np.float32),
        winSize=(WINDOW_PX, WINDOW_PX), maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 15, 0.02),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return np.asarray(end, np.float32).reshape(-1, 2), np.asarray(found).ravel() > 0
