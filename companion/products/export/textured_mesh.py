"""Mesh with the flight's pictures on it: each triangle has the picture that shows it best.

Best is from the front, from near, and away from the picture's border; of pictures about as good, a
triangle takes the one that its neighbours have, so that seams are few. Pictures are made as bright
as the cloud, whose colours are means of many.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array
from companion.messages import Bytes, Floats
from companion.products.export.flight_pictures import FlightPictures, PlacedPicture
from companion.products.export.mesh import Ints, Mesh
from companion.products.export.picture_sight import depth_buffer, is_uncovered, projected, within

STEP = 0.15
"""Pictures apart by this share of the distance: each place is in several."""
LEAST_COSINE = 0.25
"""Triangles that are seen more from the side than 75 degrees take no picture."""
N_BEST = 3
ABOUT_AS_GOOD = 0.5
"""Merit, as a share of the best one's, with which a neighbour's picture is taken instead."""
N_SMOOTHED = 4
MOST_GAIN = 1.5
"""Beyond it a picture is not darker than the cloud, but shows something else."""


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """Triangles with one picture: faces (F, 3) of vertices (V, 3), which are at pixels (V, 2)."""

    vertices: Array
    faces: Ints
    pixels: Array
    rgb: Bytes


@dataclass(frozen=True, slots=True, eq=False)
class TexturedMesh:
    """Patches of pictures, and the rest of the mesh, which no picture shows."""

    patches: list[Patch]
    rest: Mesh
    share: float
    """Share of the triangles that have a picture."""


def textured_mesh(mesh: Mesh, pictures: FlightPictures) -> TexturedMesh:
    """Give triangles pictures; InputError where the flight has none of the run."""
    corners = mesh.vertices[mesh.faces]
    middles = corners.mean(1)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    merits = np.zeros((len(mesh.faces), N_BEST), np.float32)
    labels = np.full((len(mesh.faces), N_BEST), -1, np.int32)
    kept: list[PlacedPicture] = []
    for picture in pictures.spaced(STEP):
        merit = _merit(mesh, middles, normals, picture, pictures.camera)
        shown = np.flatnonzero(merit > merits[:, -1])
        if not len(shown):
            continue
        merits[shown, -1], labels[shown, -1] = merit[shown], len(kept)
        order = np.argsort(-merits[shown], axis=1, kind="stable")
        merits[shown] = np.take_along_axis(merits[shown], order, 1)
        labels[shown] = np.take_along_axis(labels[shown], order, 1)
        kept.append(_as_bright(picture, mesh, middles, shown, pictures.camera))
    chosen = _with_neighbours(mesh.faces, merits, labels)
    patches = []
    for number in np.unique(chosen[chosen >= 0]).tolist():
        used, faces = np.unique(mesh.faces[chosen == number], return_inverse=True)
        vertices = mesh.vertices[used]
        pixels, _ = projected(vertices, kept[number].pose.world_from_camera, pictures.camera)
        patches.append(Patch(vertices, faces.reshape(-1, 3), pixels, kept[number].rgb))
    used, faces = np.unique(mesh.faces[chosen < 0], return_inverse=True)
    rest = Mesh(mesh.vertices[used], faces.reshape(-1, 3), mesh.rgb[used], mesh.cell)
    return TexturedMesh(patches, rest, float(np.mean(chosen >= 0)))


def _merit(
    mesh: Mesh, middles: Array, normals: Array, picture: PlacedPicture, camera: Camera
) -> Floats:
    """Merit (F,) of a picture for each triangle; 0 where it does not show all of it."""
    pose = picture.pose.world_from_camera
    out = np.zeros(len(middles), np.float32)
    pixels, depth = projected(mesh.vertices, pose, camera)
    nearest = depth_buffer(pixels, depth, camera)
    whole = (within(pixels, camera) & (depth > 0))[mesh.faces].all(1)
    there = np.flatnonzero(whole)
    rays = middles[there] - pose.translation
    away = np.linalg.norm(rays, axis=1)
    cosine = -(rays * normals[there]).sum(1) / np.maximum(away, 1e-9)
    at, middle_depth = projected(middles[there], pose, camera)
    good = (cosine > LEAST_COSINE) & is_uncovered(at, middle_depth, nearest)
    centre = np.array([camera.width - 1, camera.height - 1]) / 2
    inwards = 1.02 - np.abs((at - centre) / (centre + 1)).max(1)
    out[there] = np.where(good, cosine * np.minimum(inwards, 0.5) / away, 0.0)
    return out


def _as_bright(
    picture: PlacedPicture, mesh: Mesh, middles: Array, shown: NDArray[np.intp], camera: Camera
) -> PlacedPicture:
    """The picture with the mean brightness of the mesh where it shows it."""
    at, _ = projected(middles[shown], picture.pose.world_from_camera, camera)
    columns, rows = np.rint(at).astype(np.int64).T
    has = picture.rgb[rows, columns].mean()
    wanted = mesh.rgb[mesh.faces[shown, 0]].mean()
    gain = float(np.clip(wanted / max(has, 1.0), 1 / MOST_GAIN, MOST_GAIN))
    return picture._replace(rgb=np.asarray(cv2.convertScaleAbs(picture.rgb, alpha=gain), np.uint8))


def _with_neighbours(faces: Ints, merits: Floats, labels: NDArray[np.int32]) -> NDArray[np.int32]:
    """Picture (F,) of each triangle, -1 for none: of its good ones the neighbours' favourite."""
    a, b = _neighbours(faces)
    possible = (merits >= ABOUT_AS_GOOD * merits[:, :1]) & (labels >= 0)
    chosen = labels[:, 0].copy()
    for _ in range(N_SMOOTHED):
        votes = np.zeros(labels.shape, np.int32)
        for ours, theirs in ((a, b), (b, a)):
            same = labels[ours] == chosen[theirs, None]
            np.add.at(votes, ours, same & possible[ours])
        # one more for what it has, so that nothing goes to and fro
        votes += labels == chosen[:, None]
        best = np.where(possible, votes, -1).argmax(1)
        chosen = np.take_along_axis(labels, best[:, None], 1)[:, 0]
    return chosen


def _neighbours(faces: Ints) -> tuple[Ints, Ints]:
    """Pairs of triangles that share an edge."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    keys = edges[:, 0] * (faces.max(initial=0) + 1) + edges[:, 1]
    order = np.argsort(keys, kind="stable")
    same = np.flatnonzero(keys[order[1:]] == keys[order[:-1]])
    return order[same] // 3, order[same + 1] // 3
