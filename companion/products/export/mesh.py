"""Surface mesh of a cloud: marching cubes over an implicit surface of points with normals.

The surface is where the mean of the signed distances to the tangent planes of the nearest points is
zero (implicit moving least squares: Kolluri 2008; tangent planes: Hoppe et al. 1992). It ends where
points do: nothing is closed that was not seen.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from companion.errors import InputError
from companion.geometry.transforms import Array
from companion.messages import Bytes
from companion.products.cloud import Cloud
from companion.products.export.smoothing import smoothed

BLOCK = 48
"""Cells of a block, along each side: 1 MB of distances, whatever the size of the map."""
NEIGHBOURS = 16
REACH_CELLS = 2.5
"""Points farther away than so many cells do not count at a corner."""
LEAST_NEIGHBOURS = 3
TRIM_CELLS = 1.2
"""The surface goes so far beyond its points."""
N_AROUND, MOST_ASIDE = 8, 0.8
"""It is kept farther from them where they lie around it: the mean of the nearest is not farther
away than this share of their mean distance. Beyond the border of a plane that is 1."""
N_ROUGH, N_SPREAD = 12, 2
MOST_ROUGH = 0.2
"""Cells by which the planes of the nearest points may scatter, once smoothed: beyond it points are
of no surface, or of a wrong one."""
N_COLOURS = 4
N_SPACING = 2000
CELLS_PER_SPACING = 2.0
MAX_CELLS = 400_000_000

Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Vertices (V, 3) f64 and faces (F, 3), counter-clockwise from outside; colours (V, 3).

    `cell` is the side of the cells, all in the world of the cloud.
    """

    vertices: Array
    faces: Ints
    rgb: Bytes
    cell: float


def mesh_of(cloud: Cloud, cell: float = 0.0) -> Mesh:
    """Mesh a cloud; `cell` 0 takes twice the spacing of its points.

    InputError where scikit-image is missing, no point has a normal, or cells are too many.
    """
    known = np.linalg.norm(cloud.normals, axis=1) > 0.5
    if known.sum() < NEIGHBOURS:
        raise InputError("the cloud has next to no points with a normal: no mesh can be made of it")
    cloud = cloud.part(known)
    points = cloud.points.astype(np.float64)
    tree = cKDTree(points)
    if not cell:
        sample = points[:: max(1, len(points) // N_SPACING)]
        distance, _ = tree.query(sample, k=2)
        cell = float(f"{CELLS_PER_SPACING * max(np.median(distance[:, 1]), 1e-3):.2g}")
    cloud = smoothed(cloud)
    points = cloud.points.astype(np.float64)
    tree = cKDTree(points)
    low = points.min(0) - 4 * cell
    at = np.floor((points - low) / cell).astype(np.int64)
    if len(np.unique(at // BLOCK, axis=0)) * BLOCK**3 > MAX_CELLS:
        raise InputError(f"cells of {cell:g} m are too many: set expert.export.mesh_m larger")
    vertices, faces, n = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0
    for block, near in _blocks(at):
        some, theirs = _surface(block * BLOCK, at[near], low, cell, tree, cloud)
        vertices.append(some)
        faces.append(theirs + n)
        n += len(some)
    merged, corners = _merged(np.concatenate(vertices), np.concatenate(faces), cell)
    return _trimmed(merged, corners, tree, cloud, cell)


def _blocks(at: Ints) -> Iterator[tuple[Ints, Ints]]:
    """Blocks that points at cells (N, 3) reach, and the indices of points in and around each."""
    reach = int(np.ceil(REACH_CELLS)) + 1
    own, which = np.unique(at // BLOCK, axis=0, return_inverse=True)
    order = np.argsort(which.ravel(), kind="stable")
    parts = np.split(order, np.cumsum(np.bincount(which.ravel()))[:-1])
    held = {tuple(block): part for block, part in zip(own.tolist(), parts, strict=True)}
    shifts = itertools.product((-reach, reach), repeat=3)
    touched = np.unique(
        np.concatenate([np.unique((at + shift) // BLOCK, axis=0) for shift in shifts]), axis=0
    )
    for block in touched.tolist():
        around = itertools.product(*((v - 1, v, v + 1) for v in block))
        near = [held[each] for each in around if each in held]
        yield np.array(block), np.concatenate(near)


def _surface(
    first: Ints, at: Ints, low: Array, cell: float, tree: cKDTree, cloud: Cloud
) -> tuple[Array, Ints]:
    """Vertices and faces in the block of cells that begins at `first`."""
    try:
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise InputError("a mesh needs scikit-image: pip install '.[mesh]' in a clone") from error
    reach = int(np.ceil(REACH_CELLS))
    side = BLOCK + 1 + 2 * reach
    occupied = np.zeros((side, side, side), bool)
    inside = at - first + reach
    inside = inside[((inside >= 0) & (inside < side)).all(1)]
    occupied[tuple(inside.T)] = True
    close = binary_dilation(occupied, np.ones((3, 3, 3)), iterations=reach)
    corners = np.argwhere(close[reach:-reach, reach:-reach, reach:-reach])
    value = np.ones((BLOCK + 1,) * 3, np.float32)
    known = np.zeros(value.shape, bool)
    distances, enough = _distances(low + (first + corners) * cell, cell, tree, cloud)
    value[tuple(corners.T)] = np.where(enough, distances, 1.0)
    known[tuple(corners.T)] = enough
    if not (value < 0).any() or not (value > 0).any():
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    found: Any = marching_cubes(value, 0.0, gradient_direction="descent")  # type: ignore[no-untyped-call]
    places, faces = np.asarray(found[0], np.float64), np.asarray(found[1], np.int64)
    # a vertex lies on the edge between two corners; both must be known
    ends = np.floor(places).astype(np.int64), np.ceil(places).astype(np.int64)
    good = known[tuple(ends[0].T)] & known[tuple(ends[1].T)]
    return low + (first + places) * cell, faces[good[faces].all(1)]


def _distances(
    corners: Array, cell: float, tree: cKDTree, cloud: Cloud
) -> tuple[Array, NDArray[np.bool_]]:
    """Signed distance (N,) in cells, positive on the side that was seen; True where known."""
    reach = REACH_CELLS * cell
    away, index = tree.query(corners, k=NEIGHBOURS, distance_upper_bound=reach)
    there = np.isfinite(away)
    index = np.where(there, index, 0)
    weight = np.where(there, np.exp(-((away / (0.5 * reach)) ** 2)), 0.0)
    weight *= cloud.confidence[index] + 1e-3
    offset = corners[:, None] - cloud.points[index]
    planes = (offset * cloud.normals[index]).sum(-1)
    total = weight.sum(1)
    distance = (weight * planes).sum(1) / np.maximum(total, 1e-12) / cell
    return distance, there.sum(1) >= LEAST_NEIGHBOURS


def _merged(vertices: Array, faces: Ints, cell: float) -> tuple[Array, Ints]:
    """Vertices of neighbouring blocks made one."""
    keys = np.rint(vertices / (1e-4 * cell)).astype(np.int64)
    _, first, which = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    joined = which.ravel()[faces]
    proper = (joined != np.roll(joined, 1, axis=1)).all(1) if len(joined) else np.zeros(0, bool)
    return vertices[first], joined[proper]


def _roughness(vertices: Array, faces: Ints, tree: cKDTree, cloud: Cloud) -> Array:
    """Scatter (V,) of the distances to the tangent planes of the nearest points.

    The mean over neighbouring vertices, so that what is left out is left out in one piece.
    """
    _, index = tree.query(vertices, k=N_ROUGH)
    offset = vertices[:, None] - cloud.points[index]
    rough = (offset * cloud.normals[index]).sum(-1).std(1)
    ends = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    times = np.bincount(ends[:, 0], minlength=len(vertices))
    for _ in range(N_SPREAD):
        around = np.bincount(ends[:, 0], rough[ends[:, 1]], len(vertices))
        rough = 0.5 * (rough + np.where(times > 0, around / np.maximum(times, 1), rough))
    return np.asarray(rough)


def _trimmed(vertices: Array, faces: Ints, tree: cKDTree, cloud: Cloud, cell: float) -> Mesh:
    """Without what lies beyond the points or is too rough, with the colours of the nearest."""
    if not len(faces):
        raise InputError("no surface could be found in the cloud")
    away, index = tree.query(vertices, k=N_AROUND)
    aside = np.linalg.norm(cloud.points[index].mean(1) - vertices, axis=1)
    good = (away[:, 0] < TRIM_CELLS * cell) | (aside < MOST_ASIDE * away.mean(1))
    good &= _roughness(vertices, faces, tree, cloud) < MOST_ROUGH * cell
    faces = faces[good[faces].all(1)]
    if not len(faces):
        raise InputError("no surface could be found in the cloud: its points scatter too much")
    used, faces = np.unique(faces, return_inverse=True)
    weight = 1.0 / np.maximum(away[used, :N_COLOURS], 0.1 * cell)
    colours = weight[..., None] * cloud.rgb[index[used, :N_COLOURS]]
    rgb = colours.sum(1) / weight.sum(1, keepdims=True)
    return Mesh(vertices[used], faces.reshape(-1, 3), np.rint(rgb).astype(np.uint8), cell)
