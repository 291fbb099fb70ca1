"""Bilateral smoothing of a cloud along its normals, before a surface is made of it.

Errors of depth are alike within some pixels, half a metre at 30 m, so that the nearest points do
not average them away. Each point goes onto the mean of the planes around it, within some standard
deviations; planes of another direction, and beyond the noise, count for nothing, which keeps edges
(Jones et al. 2003). The planes are smoothed alike first, so that more of them agree with a point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from companion.geometry.transforms import Array
from companion.products.cloud import Cloud

REACH_SIGMAS = 8.0
"""Radius of a neighbourhood in standard deviations of its point: some ten pixels."""
PER_REACH = 4
"""Planes along that radius: the cloud is averaged in voxels first."""
NEIGHBOURS = 48
MOST_OFF_SIGMAS = 2.0
"""Standard deviation of how far a plane may pass from the point."""
PASSES_OF_PLANES = 2
"""The planes are first smoothed so often among themselves, which are a tenth of the points."""
AT_ONCE = 40_000


def smoothed(cloud: Cloud) -> Cloud:
    """The cloud with its points moved along the mean of the normals around them, which they get.

    All must have a normal. As it is where no standard deviation is known.
    """
    if not np.isfinite(cloud.sigma).any():
        return cloud
    sigma = np.where(np.isfinite(cloud.sigma), cloud.sigma, np.nanmax(cloud.sigma))
    sigma = np.maximum(sigma, 1e-6).astype(np.float64)
    places, normals = cloud.points.astype(np.float64), cloud.normals.astype(np.float64)
    planes = _planes(places, normals, sigma)
    for _ in range(PASSES_OF_PLANES):
        moved, turned = _moved(planes.places, planes.normals, planes.sigma, planes)
        planes = replace(planes, places=moved, normals=turned)
    moved, turned = _moved(places, normals, sigma, planes)
    return replace(cloud, points=moved.astype(np.float32), normals=turned.astype(np.float32))


@dataclass(frozen=True, slots=True, eq=False)
class _Planes:
    """Means of voxels: places (V, 3), normals (V, 3), standard deviations and weights (V,)."""

    places: Array
    normals: Array
    sigma: Array
    weights: Array


def _moved(places: Array, normals: Array, sigma: Array, planes: _Planes) -> tuple[Array, Array]:
    """Places (N, 3) on the mean of the planes around them, and the normals (N, 3) of that."""
    tree = cKDTree(planes.places)
    most = REACH_SIGMAS * float(np.quantile(sigma, 0.95))
    moved, turned = np.empty_like(places), np.empty_like(normals)
    for first in range(0, len(places), AT_ONCE):
        some = slice(first, first + AT_ONCE)
        away, index = tree.query(places[some], k=NEIGHBOURS, distance_upper_bound=most)
        there = np.isfinite(away)
        index, away = np.where(there, index, 0), np.where(there, away, np.inf)
        own = sigma[some, None]
        plane = planes.normals[index]
        off = ((planes.places[index] - places[some, None]) * plane).sum(-1)
        weight = planes.weights[index] * np.exp(-((away / (0.5 * REACH_SIGMAS * own)) ** 2))
        weight *= np.maximum((plane * normals[some, None]).sum(-1), 0.0) ** 2
        weight *= np.exp(-0.5 * (off / (MOST_OFF_SIGMAS * own)) ** 2)
        total = np.maximum(weight.sum(1, keepdims=True), 1e-12)
        turned[some] = mean = _unit((weight[..., None] * plane).sum(1))
        moved[some] = places[some] + (weight * off).sum(1, keepdims=True) / total * mean
    return moved, turned


def _planes(points: Array, normals: Array, sigma: Array) -> _Planes:
    """Means of the points of each voxel, weighted by 1/sigma²."""
    voxel = REACH_SIGMAS * float(np.median(sigma)) / PER_REACH
    cells = np.floor(points / voxel).astype(np.int64)
    _, which, n = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    which = which.ravel()
    weight = sigma**-2
    total = np.asarray(np.bincount(which, weight), np.float64)

    def sums(of: Array) -> Array:
        return np.stack([np.bincount(which, weight * axis) for axis in of.T], 1)

    return _Planes(
        sums(points) / total[:, None], _unit(sums(normals)), np.bincount(which, sigma) / n, total
    )


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, 1e-12))
