"""3D Tiles 1.1: one tile with the mesh as glTF, placed on the Earth."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np

from companion.geometry.geodesy import GeoOrigin, earth_from_ned
from companion.geometry.transforms import Array
from companion.products.export.flight_pictures import enu

CONTENT = "mesh.glb"


def tileset_files(
    glb: bytes, vertices_ned: Array, cell_m: float, origin: GeoOrigin
) -> Iterator[tuple[str, bytes]]:
    """Names and contents: tileset.json, and the mesh in the axes of `mesh_gltf`.

    Viewers take the y of glTF for up, so that what they place is east, north, up.
    """
    zero, (north, east, down) = earth_from_ned(origin)
    earth_from_enu = np.eye(4)
    earth_from_enu[:3] = np.column_stack([east, north, -down, zero])
    places = enu(vertices_ned)
    low, high = places.min(0), places.max(0)
    half = np.maximum((high - low) / 2, cell_m)
    root = {
        "transform": earth_from_enu.T.ravel().tolist(),  # column by column
        "boundingVolume": {"box": [*((low + high) / 2), *np.diag(half).ravel()]},
        "geometricError": 0.0,
        "refine": "REPLACE",
        "content": {"uri": CONTENT},
    }
    whole = {
        "asset": {"version": "1.1"},
        # of showing nothing instead: the size of it
        "geometricError": float(np.linalg.norm(high - low)),
        "root": root,
    }
    yield "tileset.json", (json.dumps(whole, indent=1) + "\n").encode()
    yield CONTENT, glb
