"""Mesh of clouds of known shape, and its files read back."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
import trimesh

from companion.errors import InputError
from companion.products.cloud import Cloud
from companion.products.export.mesh import Mesh, mesh_of
from companion.products.export.mesh_files import mesh_gltf, mesh_ply

RADIUS_M = 6.0
CENTRE = np.array([30.0, -20.0, -4.0])


def dome(rng: np.random.Generator, n: int = 30_000, noise_m: float = 0.05) -> Cloud:
    """The upper half of a ball, seen from outside, red towards the north."""
    outwards = rng.normal(size=(n, 3))
    outwards[:, 2] = -np.abs(outwards[:, 2])
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    away = RADIUS_M + rng.normal(0, noise_m, (n, 1))
    rgb = np.full((n, 3), 40, np.uint8)
    rgb[outwards[:, 0] > 0, 0] = 240
    return Cloud(
        (CENTRE + away * outwards).astype(np.float32), rgb, np.ones(n, np.float32),
        outwards.astype(np.float32), np.full(n, noise_m, np.float32),
    )  # fmt: skip


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return mesh_of(dome(np.random.default_rng(1)), 0.25)


def test_surface_lies_within_the_noise(mesh: Mesh) -> None:
    away = np.linalg.norm(mesh.vertices - CENTRE, axis=1) - RADIUS_M
    assert np.abs(away).mean() < 0.03
    assert np.quantile(np.abs(away), 0.99) < 0.1
    assert abs(away.mean()) < 0.01


def test_surface_is_whole_open_below_and_faces_outwards(mesh: Mesh) -> None:
    made = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert made.area == pytest.approx(2 * np.pi * RADIUS_M**2, rel=0.06)
    # a sheet with one rim: no holes where blocks meet
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    ends, times = np.unique(edges, axis=0, return_counts=True)
    assert set(times) <= {1, 2}
    rim = mesh.vertices[ends[times == 1].ravel()]
    assert (rim[:, 2] > CENTRE[2] - 0.5).all()
    outwards = made.triangles_center - CENTRE
    assert ((made.face_normals * outwards).sum(1) > 0).mean() > 0.999


def test_colours_are_those_of_the_points(mesh: Mesh) -> None:
    north = mesh.vertices[:, 0] - CENTRE[0]
    assert (mesh.rgb[north > 0.5, 0] > 230).all()
    assert (mesh.rgb[north < -0.5, 0] < 50).all()


def test_nothing_is_closed_that_was_not_seen(rng: np.random.Generator) -> None:
    """Two pieces of ground with 4 m between them stay two."""
    places = rng.uniform([0, 0, 0], [10, 10, 0.02], (8000, 3))
    places = places[(places[:, 0] < 3) | (places[:, 0] > 7)]
    n = len(places)
    cloud = Cloud(
        places.astype(np.float32), np.zeros((n, 3), np.uint8), np.ones(n, np.float32),
        np.tile(np.array([0, 0, -1], np.float32), (n, 1)), np.ones(n, np.float32),
    )  # fmt: skip
    between = mesh_of(cloud, 0.3).vertices
    assert not ((between[:, 0] > 3.5) & (between[:, 0] < 6.5)).any()
    assert np.abs(between[:, 2] - 0.01).max() < 0.05


def test_files_read_back(mesh: Mesh) -> None:
    ply: Any = trimesh.load(io.BytesIO(mesh_ply(mesh)), file_type="ply", process=False)
    np.testing.assert_allclose(ply.vertices, mesh.vertices, atol=1e-5)
    assert (ply.faces == mesh.faces).all()
    assert (ply.visual.vertex_colors[:, :3] == mesh.rgb).all()
    data = mesh_gltf(mesh)
    assert data[:4] == b"glTF"
    scene: Any = trimesh.load(io.BytesIO(data), file_type="glb", process=False)
    (gltf,) = scene.geometry.values()
    north, east, down = mesh.vertices.T
    np.testing.assert_allclose(gltf.vertices, np.stack([east, -down, -north], 1), atol=1e-4)
    linear = gltf.visual.vertex_attributes["color"][:, :3] / 65535
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert (np.rint(255 * srgb) == mesh.rgb).all()
    assert b'"extensionsUsed":["KHR_materials_unlit"]' in data
    up = gltf.face_normals[np.argmax(gltf.triangles_center[:, 1])]
    assert up[1] > 0.8


def test_what_cannot_be_meshed_is_said(rng: np.random.Generator) -> None:
    cloud = dome(rng)
    blind = Cloud(cloud.points, cloud.rgb, cloud.confidence, 0 * cloud.normals, cloud.sigma)
    with pytest.raises(InputError, match="no mesh can be made"):
        mesh_of(blind)
    with pytest.raises(InputError, match=r"set expert\.export\.mesh_m larger"):
        mesh_of(cloud, 1e-3)
