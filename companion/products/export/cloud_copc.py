"""Point cloud as a Cloud Optimized Point Cloud (COPC 1.0): LAZ in an octree, coarse to fine."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import laspy
import numpy as np
from numpy.typing import NDArray

from companion.errors import InputError
from companion.geometry.transforms import Array
from companion.products.cloud import Cloud
from companion.products.export.cloud_las import STEP_M
from companion.products.export.map_frame import MapFrame

POINT_FORMAT = 7
CELLS = 128
"""Cells along a node: it has one point in each at most, as the format advises."""
DEEPEST = 20


def cloud_copc(cloud: Cloud, frame: MapFrame) -> bytes:
    """Points to the millimetre, colours of 16 bits, confidence as intensity (65535 is 1).

    InputError where copclib is missing or the cloud is empty.
    """
    try:
        import copclib
    except ImportError as error:
        raise InputError("COPC needs copclib: pip install '.[survey]' in a clone") from error
    if not len(cloud):
        raise InputError("the cloud has no points: an octree of none cannot be")
    places = frame.coordinates(cloud.points.astype(np.float64))
    low, high = places.min(0), places.max(0)
    offset = np.floor(low)
    records = _records(cloud, places, offset)
    size = max(float((high - low).max()), STEP_M) * (1 + 1e-6)
    config = copclib.CopcConfigWriter(
        POINT_FORMAT, copclib.Vector3(*[STEP_M] * 3), copclib.Vector3(*offset),
        frame.wkt_with_height,
    )  # fmt: skip
    header, info = config.las_header, config.copc_info
    header.min, header.max = copclib.Vector3(*low), copclib.Vector3(*high)
    info.center_x, info.center_y, info.center_z = low + size / 2
    info.halfsize, info.spacing = size / 2, size / CELLS
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cloud.copc.laz"
        writer = copclib.FileWriter(str(path), config)
        for key, index in octree((places - low) / size):
            data = copclib.VectorChar(np.frombuffer(records[index].tobytes(), np.int8))
            writer.AddNode(copclib.VoxelKey(*key), data)
        writer.Close()
        return path.read_bytes()


def octree(unit: Array) -> Iterator[tuple[tuple[int, int, int, int], NDArray[np.int64]]]:
    """Nodes (depth, x, y, z) and the indices of their points, of places (N, 3) in 0..1.

    Each node has what its parents have left, one point a cell; the deepest have the rest.
    """
    left = np.arange(len(unit))
    for depth in range(DEEPEST + 1):
        if not len(left):
            return
        cells = np.floor(unit[left] * (CELLS << depth)).astype(np.int64)
        first = np.arange(len(left))
        if depth < DEEPEST:
            _, first = np.unique(cells, axis=0, return_index=True)
        nodes, which = np.unique(cells[first] // CELLS, axis=0, return_inverse=True)
        order = np.argsort(which.ravel(), kind="stable")
        ends = np.cumsum(np.bincount(which.ravel()))[:-1]
        for node, part in zip(nodes.tolist(), np.split(order, ends), strict=True):
            x, y, z = node
            yield (depth, x, y, z), left[first[part]]
        left = np.delete(left, first)


def _records(cloud: Cloud, places: Array, offset: Array) -> NDArray[np.void]:
    """Points as they lie in a LAS file."""
    header = laspy.LasHeader(version="1.4", point_format=POINT_FORMAT)
    header.offsets, header.scales = offset, np.full(3, STEP_M)
    las = laspy.LasData(header)
    las.x, las.y, las.z = places.T
    las.red, las.green, las.blue = cloud.rgb.astype(np.uint16).T * 257
    las.intensity = np.rint(cloud.confidence.clip(0, 1) * 65535).astype(np.uint16)
    las.return_number = np.ones(len(cloud), np.uint8)
    las.number_of_returns = np.ones(len(cloud), np.uint8)
    records: NDArray[np.void] = las.points.array
    return records
