"""The cloud as a binary PLY file."""

from __future__ import annotations

import numpy as np

from companion.messages import GeoOrigin
from companion.output.flight_result import Cloud
from companion.output.trajectory import frame_lines

VERTEX = np.dtype(
    [
        ("x", "<f4"), ("y", "<f4"), ("z", "<f4"),
        ("red", "u1"), ("green", "u1"), ("blue", "u1"),
        ("confidence", "<f4"),
    ]
)  # fmt: skip
KINDS = {"f": "float", "u": "uchar"}


def cloud_ply(cloud: Cloud, unit: str, origin: GeoOrigin | None) -> bytes:
    """Vertices with x y z, red green blue and confidence (0..1), little-endian."""
    head = [
        "ply",
        "format binary_little_endian 1.0",
        *("comment " + line for line in frame_lines(unit, origin)),
        f"element vertex {len(cloud)}",
        *(f"property {KINDS[VERTEX[name].kind]} {name}" for name in VERTEX.names or ()),
        "end_header",
    ]
    vertices = np.zeros(len(cloud), VERTEX)
    for axis, name in enumerate("xyz"):
        vertices[name] = cloud.points[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = cloud.rgb[:, channel]
    vertices["confidence"] = cloud.confidence
    return ("\n".join(head) + "\n").encode("ascii") + vertices.tobytes()
