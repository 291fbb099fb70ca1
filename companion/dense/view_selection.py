"""Which images are worth their time: the few that see a reference from places far apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array, Pose

MAX_VIEWS = 6
"""Images that a depth is made of."""
LEAST_BASELINE = 0.015
"""Of the middle depth; an image from nearer by says nothing."""
NOVEL = 0.2
"""Of its baseline; an image nearer than this to one already taken says nothing new."""
SHORT = 0.2
"""Of the middle depth; shorter baselines than this count as alike."""
LEAST_OVERLAP = 0.5
"""Share of the reference that an image must see, at the middle depth."""
LONGEST_BASELINE = 0.6
"""Of the middle depth; from further away things look different."""
MAX_TURN_RAD = np.radians(35.0)


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """An ideal pinhole camera, in pixels."""

    fx: float
    fy: float
    cx: float
    cy: float

    def matrix(self) -> Array:
        """The (3, 3) intrinsic matrix."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A kept image: the slot that it lies in, and where it was taken from."""

    slot: int
    current_from_reference: Pose
    centre: Array
    """(3,) in the reference's frame."""


class Views:
    """The images kept for one reference, at most `MAX_VIEWS`; a better one takes another's slot."""

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
        """Images since `begin` that were worth a thought, whether they were kept or not."""
        self.n_kept = 0
        """Of them those that were kept, whether they still are or not."""
        self._seen: list[Array] = []

    def begin(self, rho_low: float, rho_high: float) -> None:
        """Forget all; depths of the new reference have inverses between these two."""
        self._rho = 0.5 * (rho_low + rho_high)
        self._range = (rho_high, rho_low)
        self.kept = []
        self.n_novel = self.n_kept = 0
        self._seen = [np.zeros(3)]

    def consider(self, current_from_reference: Pose) -> View | None:
        """The view under which an image is to be kept; None if it is not worth it.

        An image without parallax, from about where another was taken, from very far away, or that
        sees less than half, is not.
        """
        pose = current_from_reference
        centre = pose.inverse().translation
        if not (np.isfinite(centre).all() and np.isfinite(pose.rotation).all()):
            return None
        baseline = float(np.linalg.norm(centre)) * self._rho
        if baseline > LONGEST_BASELINE:
            return None
        apart = np.linalg.norm(np.array(self._seen) - centre, axis=1) * self._rho
        if float(apart.min()) < max(LEAST_BASELINE, NOVEL * baseline) or not self._overlaps(pose):
            return None
        self._seen.append(centre)
        self.n_novel += 1
        view = View(len(self.kept), pose, centre)
        if len(self.kept) < MAX_VIEWS:
            self.kept.append(view)
            self.n_kept += 1
            return view
        out = self._least_needed([*self.kept, view])
        if out == MAX_VIEWS:
            return None
        view = View(self.kept[out].slot, pose, centre)
        self.kept[out] = view
        self.n_kept += 1
        return view

    def _overlaps(self, pose: Pose) -> bool:
        if np.arccos(np.clip(pose.rotation[2, 2], -1.0, 1.0)) > MAX_TURN_RAD:
            return False
        points = pose.apply(self._rays / self._rho)
        front = points[:, 2] > 1e-6
        z = np.where(front, points[:, 2], 1.0)
        u = self._k.fx * points[:, 0] / z + self._k.cx
        v = self._k.fy * points[:, 1] / z + self._k.cy
        width, height = self._size
        seen = front & (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
        return float(seen.mean()) >= LEAST_OVERLAP

    def spread(self) -> float:
        """How far apart the kept images and the reference are, as a share of the middle depth."""
        centres = np.array([np.zeros(3), *(view.centre for view in self.kept)])
        apart = np.linalg.norm(centres[:, None] - centres[None], axis=2)
        return float(np.sqrt((apart**2).mean())) * self._rho

    def _least_needed(self, views: list[View]) -> int:
        """Index of the view that has another nearest to it, in proportion to their baselines.

        The shortest baselines, which hide least behind edges, so stay among the longest.
        """
        centres = np.array([view.centre for view in views])
        length = np.linalg.norm(centres, axis=1)
        apart = np.linalg.norm(centres[:, None] - centres[None], axis=2)
        longer = np.maximum(length[:, None], length[None])
        relative = apart / np.maximum(longer, SHORT / self._rho)
        np.fill_diagonal(relative, np.inf)
        order = np.sort(relative, axis=1)
        # of the nearest two the one whose next neighbour is nearer
        return int(np.lexsort((order[:, 1], order[:, 0]))[0])

    def parallax_px(self) -> float:
        """By how many pixels a point moves between the least and the greatest depth, at most.

        Of the kept images the one where it moves most, and there the median over the image.
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
