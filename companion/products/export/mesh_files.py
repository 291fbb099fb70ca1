"""Mesh as PLY and as binary glTF, with colours of its vertices or with pictures."""

from __future__ import annotations

import io
from typing import Any

import cv2
import numpy as np

from companion.errors import InputError
from companion.geometry.transforms import Array
from companion.products.export.flight_pictures import enu
from companion.products.export.mesh import Mesh
from companion.products.export.textured_mesh import Patch, TexturedMesh

VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
COLOURS, UNLIT = "_COLOR", "KHR_materials_unlit"
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
    return _glb([_coloured(mesh)])


def textured_gltf(textured: TexturedMesh) -> bytes:
    """The same with pictures: one mesh for each, and one in colours where there is none."""
    parts = [_pictured(patch) for patch in textured.patches]
    return _glb(parts + [_coloured(textured.rest)] * bool(len(textured.rest.faces)))


def _coloured(mesh: Mesh) -> Any:
    out = _trimesh().Trimesh(_axes(mesh.vertices), mesh.faces, process=False)
    # trimesh writes colours as bytes, of which linear ones, as glTF's are, have few dark ones
    srgb = np.c_[mesh.rgb, np.full(len(mesh.rgb), 255)] / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    out.vertex_attributes[COLOURS] = np.rint(65535 * linear).astype(np.uint16)
    return out


def _pictured(patch: Patch) -> Any:
    from PIL import Image

    made = _trimesh()
    height, width = patch.rgb.shape[:2]
    # its texture coordinates begin below, at the border of a pixel
    places = (patch.pixels + 0.5) / [width, height] * [1, -1] + [0, 1]
    done, jpeg = cv2.imencode(".jpg", patch.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
    assert done
    material = made.visual.material.PBRMaterial(
        baseColorTexture=Image.open(io.BytesIO(jpeg.tobytes())), metallicFactor=0.0,
        roughnessFactor=1.0,
    )  # fmt: skip
    visual = made.visual.TextureVisuals(uv=places, material=material)
    return made.Trimesh(_axes(patch.vertices), patch.faces, visual=visual, process=False)


def _axes(vertices_ned: Array) -> Array:
    east, north, up = enu(vertices_ned).T
    return np.stack([east, up, -north], 1)


def _glb(parts: list[Any]) -> bytes:
    scene = _trimesh().Scene(parts)
    data: Any = scene.export(file_type="glb", include_normals=True, tree_postprocessor=_unlit)
    return bytes(data)


def _unlit(tree: Any) -> None:
    """Have colours shown as they are: they have the light of the day in them."""
    materials = tree.setdefault("materials", [])
    for primitive in (each for mesh in tree["meshes"] for each in mesh["primitives"]):
        if "material" not in primitive:
            primitive["material"] = len(materials)
            materials.append({"pbrMetallicRoughness": {"metallicFactor": 0.0}})
        places = primitive["attributes"]
        if COLOURS in places:
            places["COLOR_0"] = places.pop(COLOURS)
            tree["accessors"][places["COLOR_0"]]["normalized"] = True
    for material in materials:
        material["extensions"] = {UNLIT: {}}
    tree["extensionsUsed"] = [UNLIT]


def _trimesh() -> Any:
    try:
        import trimesh
    except ImportError as error:
        raise InputError("glTF needs trimesh: pip install '.[mesh]' in a clone") from error
    return trimesh
