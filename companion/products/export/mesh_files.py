"""Mesh as PLY and as binary glTF, with colours of its vertices."""

from __future__ import annotations

from typing import Any

import numpy as np

from companion.errors import InputError
from companion.products.export.flight_pictures import enu
from companion.products.export.mesh import Mesh

VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
FACE = np.dtype([("n", "u1"), ("corners", "<i4", 3)])


def mesh_ply(mesh: Mesh) -> bytes:
    """In the axes of the cloud, local NED, so that both lie over each other."""
    vertices = np.zeros(len(mesh.vertices), VERTEX)
    vertices["xyz"], vertices["rgb"] = mesh.vertices, mesh.rgb
    faces = np.zeros(len(mesh.faces), FACE)
    faces["n"], faces["corners"] = 3, mesh.faces
    head = [
        "ply", "format binary_little_endian 1.0", "comment local north, east, down",
        f"element vertex {len(vertices)}", *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {channel}" for channel in ("red", "green", "blue")),
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header",
    ]  # fmt: skip
    return ("\n".join(head) + "\n").encode() + vertices.tobytes() + faces.tobytes()


def mesh_gltf(mesh: Mesh) -> bytes:
    """Binary glTF 2.0: x east, y up, z south, metres from the local zero."""
    try:
        import trimesh
    except ImportError as error:
        raise InputError("glTF needs trimesh: pip install '.[mesh]' in a clone") from error
    east, north, up = enu(mesh.vertices).T
    made = trimesh.Trimesh(
        np.stack([east, up, -north], 1), mesh.faces, vertex_colors=mesh.rgb, process=False
    )
    data: Any = made.export(file_type="glb", include_normals=True)
    return bytes(data)
