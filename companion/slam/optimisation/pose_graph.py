"""Keyframes moved so that a loop closes: relative poses are springs (Strasdat et al., RSS 2010).

Each keyframe has a scale of its own, since a single camera's map drifts in scale too. Where the
vertical is known keyframes turn about it only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve

from companion.geometry.transforms import (
    Array,
    Similarity,
    rotation_from_vector,
    skew,
    vector_from_rotation,
)
from companion.slam.features.orb_features import Ints

ITERATIONS = 12
CONVERGED = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """What node `j` is to node `i`: `i_from_j`, believed by `weight`."""

    i: int
    j: int
    i_from_j: Similarity
    weight: float = 1.0


def relax(nodes: list[Similarity], edges: list[Edge], fixed: int, level: bool) -> list[Similarity]:
    """The nodes `map_from_node` that agree best with all edges; node `fixed` stays.

    With `level` nodes turn about the map's z axis only.
    """
    scale = np.log([n.scale for n in nodes])
    rotation = np.stack([n.rotation for n in nodes])
    place = np.stack([n.translation for n in nodes])
    i, j = np.array([e.i for e in edges]), np.array([e.j for e in edges])
    wanted_turn = np.stack([e.i_from_j.rotation for e in edges])
    wanted_place = np.stack([e.i_from_j.translation for e in edges])
    wanted_scale = np.log([e.i_from_j.scale for e in edges])
    root = np.sqrt([e.weight for e in edges])
    axes = np.eye(3)[:, 2:] if level else np.eye(3)
    for _ in range(ITERATIONS):
        back = rotation[i].transpose(0, 2, 1)
        apart = place[j] - place[i]
        inverse = np.exp(-scale[i])
        turn = np.matmul(back, rotation[j])
        away = np.matmul(back, apart[..., None])[..., 0] * inverse[:, None]
        off = np.matmul(turn, wanted_turn.transpose(0, 2, 1))
        residual = np.concatenate(
            [
                np.stack([vector_from_rotation(r) for r in off]),
                away - wanted_place,
                (scale[j] - scale[i] - wanted_scale)[:, None],
            ],
            1,
        )
        of_i, of_j = _jacobians(back, apart, away, inverse, axes)
        step = _solve(of_i, of_j, residual, root, i, j, len(nodes), fixed)
        k = axes.shape[1]
        for n in range(len(nodes)):
            rotation[n] = rotation_from_vector(axes @ step[n, :k]) @ rotation[n]
        place += step[:, k : k + 3]
        scale += step[:, k + 3]
        if np.abs(step).max() < CONVERGED:
            break
    return [
        Similarity(float(np.exp(s)), r, t) for s, r, t in zip(scale, rotation, place, strict=True)
    ]


def _jacobians(
    back: Array, apart: Array, away: Array, inverse: Array, axes: Array
) -> tuple[Array, Array]:
    """Derivatives (E, 7, D) of an edge's residual by turn, place and log scale of its two nodes."""
    n, k = len(back), axes.shape[1]
    of_i, of_j = np.zeros((n, 7, k + 4)), np.zeros((n, 7, k + 4))
    of_j[:, :3, :k] = back @ axes
    of_i[:, :3, :k] = -of_j[:, :3, :k]
    scaled = back * inverse[:, None, None]
    of_j[:, 3:6, k : k + 3] = scaled
    of_i[:, 3:6, k : k + 3] = -scaled
    of_i[:, 3:6, :k] = np.matmul(scaled, skew(apart)) @ axes
    of_i[:, 3:6, k + 3] = -away
    of_j[:, 6, k + 3], of_i[:, 6, k + 3] = 1.0, -1.0
    return of_i, of_j


def _solve(
    of_i: Array, of_j: Array, residual: Array, root: Array, i: Ints, j: Ints, n: int, fixed: int
) -> Array:
    """One Gauss-Newton step (n, D)."""
    size = of_i.shape[2]
    of_i, of_j = of_i * root[:, None, None], of_j * root[:, None, None]
    weighted = residual * root[:, None]
    row = np.arange(len(residual) * 7).reshape(-1, 7, 1)
    rows, columns, values = [], [], []
    for of, node in ((of_i, i), (of_j, j)):
        column = node[:, None, None] * size + np.arange(size)
        rows.append(np.broadcast_to(row, of.shape).ravel())
        columns.append(np.broadcast_to(column, of.shape).ravel())
        values.append(of.ravel())
    shape = (len(residual) * 7, n * size)
    jacobian = coo_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape
    ).tocsc()
    free = np.flatnonzero(np.arange(n * size) // size != fixed)
    jacobian = jacobian[:, free]
    normal = (jacobian.T @ jacobian).tocsc()
    normal.setdiag(normal.diagonal() + 1e-9)
    out = np.zeros(n * size)
    out[free] = spsolve(normal, -(jacobian.T @ weighted.ravel()))
    return out.reshape(n, size)
