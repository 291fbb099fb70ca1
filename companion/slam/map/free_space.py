"""Points that other keyframes look through: evidence by their own depth that nothing is there.

The points that a keyframe observes span its image with triangles of known depth (as in the carving
of free space by lines of sight, Labatut et al. 2007). A point well before the triangle that it
falls into is looked through; one in it is confirmed; one behind it is hidden, which says nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import Delaunay, QhullError

from companion.geometry.transforms import Array
from companion.slam.features.orb_features import Bools, Ints
from companion.slam.map.sparse_map import Keyframe

SIGMAS = 4.0
"""A difference of depths counts from so many standard deviations on."""
MAX_EDGE_RAD = 0.08
"""Longest side of a triangle, as an angle: over wider ones nothing is known in between."""
MIN_VIEWS, MIN_SHARE = 3, 0.8
"""Keyframes that look through a point that has gone, and their share of those that could tell."""
MIN_POINTS = 30
"""Of a keyframe, for triangles that mean something."""


@dataclass(frozen=True, slots=True, eq=False)
class Looked:
    """By point (P,): the keyframes that look through it, and those that see something there."""

    n_through: Ints
    n_confirming: Ints

    @property
    def gone(self) -> Bools:
        """Mask (P,) of points that enough keyframes look through."""
        told = self.n_through + self.n_confirming
        out: Bools = (self.n_through >= MIN_VIEWS) & (self.n_through >= MIN_SHARE * told)
        return out


def looked_through(
    keyframes: Iterable[Keyframe], positions: Array, covariances: Array, candidates: Ints,
    sigma_m: float,
) -> Looked:  # fmt: skip
    """Keyframes that look through, or confirm, each of the candidate points (ids).

    Positions (P, 3) and covariances (P, 3, 3), nan where unknown, are those of the points that the
    keyframes observe; `sigma_m` is by how much keyframes and candidates may be apart besides.
    """
    through = np.zeros(len(candidates), np.int64)
    confirming = np.zeros(len(candidates), np.int64)
    for keyframe in keyframes:
        ids = np.unique(keyframe.point_ids[keyframe.point_ids >= 0])
        ids = ids[np.isfinite(covariances[ids, 0, 0])]
        seen = keyframe.camera_from_map.apply(positions[ids])
        ids, seen = ids[seen[:, 2] > 0], seen[seen[:, 2] > 0]
        if len(ids) < MIN_POINTS:
            continue
        flat = seen[:, :2] / seen[:, 2:]
        try:
            mesh = Delaunay(flat)
        except QhullError:  # all on a line
            continue
        there = keyframe.camera_from_map.apply(positions[candidates])
        before = np.flatnonzero(there[:, 2] > 0)
        at = there[before, :2] / there[before, 2:]
        near = ((at > flat.min(0)) & (at < flat.max(0))).all(1)
        before, at = before[near], at[near]
        which = mesh.find_simplex(at)
        before, which = before[which >= 0], which[which >= 0]
        corners = mesh.simplices[which]
        sides = flat[corners] - flat[np.roll(corners, 1, 1)]
        narrow = np.linalg.norm(sides, axis=2).max(1) <= MAX_EDGE_RAD
        before, corners = before[narrow], corners[narrow]
        depth = there[before, 2]
        around = seen[corners, 2]
        axis = keyframe.camera_from_map.rotation[2]
        own, theirs = (
            np.einsum("i,nij,j->n", axis, covariances[which], axis)
            for which in (candidates[before], ids)
        )
        sigma = np.sqrt(own + theirs[corners].max(1) + sigma_m**2)
        nearest, furthest = around.min(1), around.max(1)
        through[before[depth + SIGMAS * sigma < nearest]] += 1
        inside = (depth >= nearest - SIGMAS * sigma) & (depth <= furthest + SIGMAS * sigma)
        confirming[before[inside]] += 1
    return Looked(through, confirming)
