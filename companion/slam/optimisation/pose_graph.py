"""Pose-graph optimisation over similarities for loop closure (Strasdat et al., RSS 2010).

Each keyframe has a scale of its own, since monocular maps drift in scale. Gravity-aligned maps are
rotated about the vertical only.
"""

from __future__ import annotations

from collections.abc import Collection
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
    """Relative similarity `i_from_j` between nodes `i` and `j`, with a weight."""

    i: int
    j: int
    i_from_j: Similarity
    weight: float = 1.0


def relax(
    nodes: list[Similarity], edges: list[Edge], fixed: Collection[int], level: bool
) -> list[Similarity]:
    """Nodes `map_from_node` of least squared error over all edges; nodes `fixed` are held.

    With `level` nodes rotate about the z axis of the map only.
    """
    scale = np.log([n.scale for n in nodes])
    rotation = np.stack([n.rotation for n in nodes])
    position = np.stack([n.translation for n in nodes])
    i, j = np.array([e.i for e in edges]), np.array([e.j for e in edges])
    measured_rotation = np.stack([e.i_from_j.rotation for e in edges])
    measured_translation = np.stack([e.i_from_j.translation for e in edges])
    measured_log_scale = np.log([e.i_from_j.scale for e in edges])
    root_weight = np.sqrt([e.weight for e in edges])
    axes = np.eye(3)[:, 2:] if level else np.eye(3)
    for _ in range(ITERATIONS):
        back = rotation[i].transpose(0, 2, 1)
        separation = position[j] - position[i]
        inverse = np.exp(-scale[i])
        relative_rotation = np.matmul(back, rotation[j])
        relative_position = np.matmul(back, separation[..., None])[..., 0] * inverse[:, None]
        rotation_error = np.matmul(relative_rotation, measured_rotation.transpose(0, 2, 1))
        residual = np.concatenate(
            [
                np.stack([vector_from_rotation(r) for r in rotation_error]),
                relative_position - measured_translation,
                (scale[j] - scale[i] - measured_log_scale)[:, None],
            ],
            1,
        )
        of_i, of_j = _jacobians(back, separation, relative_position, inverse, axes)
        step = _solve(of_i, of_j, residual, root_weight, i, j, len(nodes), fixed)
        k = axes.shape[1]
        for n in range(len(nodes)):
            rotation[n] = rotation_from_vector(axes @ step[n, :k]) @ rotation[n]
        position += step[:, k : k + 3]
        scale += step[:, k + 3]
        if np.abs(step).max() < CONVERGED:
            break
    return [
        Similarity(float(np.exp(s)), r, t)
        for s, r, t in zip(scale, rotation, position, strict=True)
    ]


def _jacobians(
    back: Array, separation: Array, relative_position: Array, inverse: Array, axes: Array
) -> tuple[Array, Array]:
    """Jacobians (E, 7, D) of edge residuals by rotation, position and log scale of both nodes."""
    n, k = len(back), axes.shape[1]
    of_i, of_j = np.zeros((n, 7, k + 4)), np.zeros((n, 7, k + 4))
    of_j[:, :3, :k] = back @ axes
    of_i[:, :3, :k] = -of_j[:, :3, :k]
    scaled = back * inverse[:, None, None]
    of_j[:, 3:6, k : k + 3] = scaled
    of_i[:, 3:6, k : k + 3] = -scaled
    of_i[:, 3:6, :k] = np.matmul(scaled, skew(separation)) @ axes
    of_i[:, 3:6, k + 3] = -relative_position
    of_j[:, 6, k + 3], of_i[:, 6, k + 3] = 1.0, -1.0
    return of_i, of_j


def _solve(
    of_i: Array,
    of_j: Array,
    residual: Array,
    root_weight: Array,
    i: Ints,
    j: Ints,
    n: int,
    fixed: Collection[int],
) -> Array:
    """One Gauss-Newton step (n, D)."""
    size = of_i.shape[2]
    of_i, of_j = of_i * root_weight[:, None, None], of_j * root_weight[:, None, None]
    weighted = residual * root_weight[:, None]
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
    free = np.flatnonzero(~np.isin(np.arange(n * size) // size, list(fixed)))
    jacobian = jacobian[:, free]
    normal = (jacobian.T @ jacobian).tocsc()
    normal.setdiag(normal.diagonal() + 1e-9)
    out = np.zeros(n * size)
    out[free] = spsolve(normal, -(jacobian.T @ weighted.ravel()))
    return out.reshape(n, size)
