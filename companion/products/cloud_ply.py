"""Point cloud as a binary PLY file."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from companion.geometry.geodesy import GeoOrigin
from companion.products.cloud import Cloud
from companion.products.trajectory_file import frame_lines

VERTEX = np.dtype(
    [
        ("x", "<f4"), ("y", "<f4"), ("z", "<f4"),
        ("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4"),
        ("red", "u1"), ("green", "u1"), ("blue", "u1"),
        ("confidence", "<f4"), ("sigma", "<f4"),
    ]
)  # fmt: skip
AT_ONCE = 100_000
"""Vertices in memory while writing."""
KINDS = {"f": "float", "u": "uchar"}


def ply_parts(cloud: Cloud, unit: str, origin: GeoOrigin | None) -> Iterator[bytes]:
    """Parts of the file: x y z, nx ny nz, red green blue, confidence, sigma, as in `Cloud`."""
    head = [
        "ply",
        "format binary_little_endian 1.0",
        *("comment " + line for line in frame_lines(unit, origin)),
        f"element vertex {len(cloud)}",
        *(f"property {KINDS[VERTEX[name].kind]} {name}" for name in VERTEX.names or ()),
        "end_header",
    ]
    yield ("\n".join(head) + "\n").encode("ascii")
    for first in range(0, len(cloud), AT_ONCE):
        some = cloud.part(slice(first, first + AT_ONCE))
        vertices = np.zeros(len(some), VERTEX)
        for axis, name in enumerate("xyz"):
            vertices[name] = some.points[:, axis]
            vertices["n" + name] = some.normals[:, axis]
        for channel, name in enumerate(("red", "green", "blue")):
            vertices[name] = some.rgb[:, channel]
        vertices["confidence"], vertices["sigma"] = some.confidence, some.sigma
        yield vertices.tobytes()
