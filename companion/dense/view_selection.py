"""View selection: a few images of a reference with well-spread baselines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array, Pose

MAX_VIEWS = 6
"""Images used for a depth map."""
MIN_BASELINE = 0.015
"""Ratio of the middle depth below which an image is useless."""
MIN_NOVELTY = 0.2
"""Ratio of its baseline; images nearer to one already used are redundant."""
SHORT_BASELINE = 0.2
"""Ratio of the middle depth; shorter baselines count as equal."""
MIN_OVERLAP = 0.5
"""Ratio of the reference that an image must see, at the middle depth."""
MAX_BASELINE = 0.6
"""Ratio of the middle depth; beyond, appearance changes too much."""
MAX_ROTATION_RAD = np.radians(35.0)


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A pinhole camera, in pixels."""

    fx: float
    fy: float
    cx: float
    cy: float

    def matrix(self) -> Array:
        """The (3, 3) intrinsic matrix."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A kept image: its slot and pose."""

    slot: int
    current_from_reference: Pose
    centre: Array
    """Position (3,) in the frame of the reference."""


class Views:
    """Images kept for one reference, at most `MAX_VIEWS`; better ones replace others."""

    def __init__(self, intrinsics: Intrinsics, width: int, height: int) -> None:
        self._k = intrinsics
        self._size = (width, height)
        u, v = np.meshgrid(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 7))
        ones = np.ones(u.size)
        self._rays = np.stack(
            [(u.ravel() - self._k.cx) / self._k.fx, (v.ravel() - self._k.cy) / self._k.fy, ones], 1
        )
        self._rho, self._range = 1.0, (1.0, 1.0)
        self.kept: list[View] = []
        self.n_novel = 0
        """Images since `begin` that were not redundant, kept or not."""
        self.n_kept = 0
        """Images since `begin` that were kept at any time."""
        self._seen: list[Array] = []

    def begin(self, rho_low: float, rho_high: float) -> None:
        """Reset for a reference with inverse depths between these."""
        self._rho = 0.5 * (rho_low + rho_high)
        self._range = (rho_high, rho_low)
        self.kept = []
        self.n_novel = self.n_kept = 0
        self._seen = [np.zeros(3)]

    def consider(self, current_from_reference: Pose) -> View | None:
        """The view to keep an image as; None if rejected.

        Rejected without parallax, near another one, too far away, or with too little overlap.
        """
        pose = current_from_reference
        centre = pose.inverse().translation
        if not (np.isfinite(centre).all() and np.isfinite(pose.rotation).all()):
            return None
        baseline = float(np.linalg.norm(centre)) * self._rho
        if baseline > MAX_BASELINE:
            return None
        distance = np.linalg.norm(np.array(self._seen) - centre, axis=1) * self._rho
        if float(distance.min()) < max(MIN_BASELINE, MIN_NOVELTY * baseline) or not self._overlaps(
            pose
        ):
            return None
        self._seen.append(centre)
        self.n_novel += 1
        view = View(len(self.kept), pose, centre)
        if len(self.kept) < MAX_VIEWS:
            self.kept.append(view)
            self.n_kept += 1
            return view
        out = self._most_redundant([*self.kept, view])
        if out == MAX_VIEWS:
            return None
        view = View(self.kept[out].slot, pose, centre)
        self.kept[out] = view
        self.n_kept += 1
        return view

    def _overlaps(self, pose: Pose) -> bool:
        if np.arccos(np.clip(pose.rotation[2, 2], -1.0, 1.0)) > MAX_ROTATION_RAD:
            return False
        points = pose.apply(self._rays / self._rho)
        front = points[:, 2] > 1e-6
        z = np.where(front, points[:, 2], 1.0)
        u = self._k.fx * points[:, 0] / z + self._k.cx
        v = self._k.fy * points[:, 1] / z + self._k.cy
        width, height = self._size
        seen = front & (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
        return float(seen.mean()) >= MIN_OVERLAP

    def spread(self) -> float:
        """RMS distance of the kept views and the reference, relative to the middle depth."""
        centres = np.array([np.zeros(3), *(view.centre for view in self.kept)])
        distance = np.linalg.norm(centres[:, None] - centres[None], axis=2)
        return float(np.sqrt((distance**2).mean())) * self._rho

    def _most_redundant(self, views: list[View]) -> int:
        """Index of the view nearest to another, relative to their baselines.

        So the shortest baselines, with least occlusion, are kept among the longest.
        """
        centres = np.array([view.centre for view in views])
        length = np.linalg.norm(centres, axis=1)
        distance = np.linalg.norm(centres[:, None] - centres[None], axis=2)
        longer = np.maximum(length[:, None], length[None])
        relative = distance / np.maximum(longer, SHORT_BASELINE / self._rho)
        np.fill_diagonal(relative, np.inf)
        order = np.sort(relative, axis=1)
        # of the nearest pair the one whose second neighbour is nearer
        return int(np.lexsort((order[:, 1], order[:, 0]))[0])

    def parallax_px(self) -> float:
        """Largest disparity between minimum and maximum depth, over the kept views.

        Per view the median over the image.
        """
        most = 0.0
        for view in self.kept:
            near, far = (view.current_from_reference.apply(self._rays / rho) for rho in self._range)
            front = (near[:, 2] > 1e-6) & (far[:, 2] > 1e-6)
            if front.any():
                a, b = near[front], far[front]
                move = a[:, :2] / a[:, 2:] - b[:, :2] / b[:, 2:]
                length = np.linalg.norm(move * [self._k.fx, self._k.fy], axis=1)
                most = max(most, float(np.median(length)))
        return most

    def projections(self) -> Array:
        """(n, 12) f32, in order of slots: rows of K (R | t) K^-1, the last column K t."""
        k = self._k.matrix()
        inverse = np.linalg.inv(k)
        out = np.zeros((len(self.kept), 3, 4))
        for view in self.kept:
            pose = view.current_from_reference
            out[view.slot] = np.c_[k @ pose.rotation @ inverse, k @ pose.translation]
        return out.reshape(-1, 12)
