"""Pictures with poses, and the cloud, in the layouts of COLMAP and of nerfstudio.

COLMAP's text model: colmap.github.io/format.html; nerfstudio's transforms.json:
docs.nerf.studio/quickstart/data_conventions.html.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose, quaternion_from_rotation
from companion.messages import Bytes
from companion.products.cloud import Cloud
from companion.products.export.flight_pictures import FlightPictures, PlacedPicture, enu
from companion.products.export.mesh import Ints
from companion.products.export.picture_sight import depth_buffer, is_uncovered, projected, within

STEP = 0.15
"""Pictures apart by this share of the distance: neighbours overlap by 80 % or so."""
JPEG_QUALITY = 95
MOST_TRACKED = 30_000
"""Points with a track: programs choose by them which pictures show the same."""
PLY_POINT = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])


def colmap_files(pictures: FlightPictures) -> Iterator[tuple[str, bytes]]:
    """images/ and sparse/0 with cameras.txt, images.txt and points3D.txt: names and contents.

    Axes are local NED. Points have tracks, up to MOST_TRACKED of them, evenly from all: the pixels
    where pictures show them, by their poses. No feature was matched there. COLMAP's centre of the
    first pixel is (0.5, 0.5), ours (0, 0).
    """
    k, cloud = pictures.camera, pictures.run.cloud
    camera = (
        f"1 PINHOLE {k.width} {k.height} {k.fx:.9g} {k.fy:.9g} {k.cx + 0.5:.9g} {k.cy + 0.5:.9g}"
    )
    every = -(-len(cloud) // MOST_TRACKED) or 1
    names, poses, seen = [], [], []
    for picture in pictures.spaced(STEP):
        names.append(_name(picture))
        poses.append(picture.pose.world_from_camera)
        seen.append(_seen(cloud, every, poses[-1], k))
        yield f"images/{names[-1]}", _jpeg(picture.rgb)
    # seen once, a point tells nothing of the pictures
    often = np.bincount(np.concatenate([each.points for each in seen]), minlength=len(cloud)) > 1
    seen = [each.part(often[each.points]) for each in seen]
    yield "sparse/0/cameras.txt", _text(["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", camera])
    yield "sparse/0/images.txt", _text(_image_lines(names, poses, seen))
    yield "sparse/0/points3D.txt", _text(_point_lines(cloud, seen))


class _Seen(NamedTuple):
    """Points of a cloud that a picture shows: numbers (N,), and pixels (N, 2)."""

    points: Ints
    pixels: Array

    def part(self, mask: NDArray[np.bool_]) -> _Seen:
        return _Seen(self.points[mask], self.pixels[mask])


def _seen(cloud: Cloud, every: int, world_from_camera: Pose, camera: Camera) -> _Seen:
    """Of each so many points those that a picture shows."""
    places = cloud.points.astype(np.float64)
    pixels, depth = projected(places, world_from_camera, camera)
    nearest = depth_buffer(pixels, depth, camera)
    back = world_from_camera.translation - places
    faces = (back * cloud.normals).sum(1) >= 0.0  # or has no normal
    some = np.arange(0, len(cloud), every)
    some = some[(within(pixels, camera) & (depth > 0) & faces)[some]]
    some = some[is_uncovered(pixels[some], depth[some], nearest)]
    return _Seen(some, pixels[some])


def _image_lines(names: list[str], poses: list[Pose], seen: list[_Seen]) -> list[str]:
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[]"]
    for n, (name, pose, shown) in enumerate(zip(names, poses, seen, strict=True), 1):
        camera_from_world = pose.inverse()
        turn = quaternion_from_rotation(camera_from_world.rotation)
        numbers = " ".join(f"{v:.12g}" for v in (*turn, *camera_from_world.translation))
        at = zip((shown.pixels + 0.5).tolist(), (shown.points + 1).tolist(), strict=True)
        lines += [f"{n} {numbers} 1 {name}", " ".join(f"{x:.2f} {y:.2f} {i}" for (x, y), i in at)]
    return lines


def _point_lines(cloud: Cloud, seen: list[_Seen]) -> list[str]:
    tracks: list[list[str]] = [[] for _ in range(len(cloud))]
    for n, shown in enumerate(seen, 1):
        for place, i in enumerate(shown.points.tolist()):
            tracks[i].append(f"{n} {place}")
    rows = zip(cloud.points.tolist(), cloud.rgb.tolist(), tracks, strict=True)
    return ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]"] + [
        " ".join([f"{n} {x:.6g} {y:.6g} {z:.6g} {red} {green} {blue} 0", *track])
        for n, ((x, y, z), (red, green, blue), track) in enumerate(rows, 1)
    ]


def nerfstudio_files(pictures: FlightPictures) -> Iterator[tuple[str, bytes]]:
    """images/, transforms.json and points.ply: names and contents.

    The world is local east, north, up in metres; cameras look along their own -z with y up, as in
    OpenGL.
    """
    k, frames = pictures.camera, []
    for picture in pictures.spaced(STEP):
        name = f"images/{_name(picture)}"
        yield name, _jpeg(picture.rgb)
        frames.append({"file_path": name, "transform_matrix": opengl_pose(picture).tolist()})
    transforms = {
        "camera_model": "OPENCV", "w": k.width, "h": k.height, "fl_x": k.fx, "fl_y": k.fy,
        "cx": k.cx + 0.5, "cy": k.cy + 0.5, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0,
        "ply_file_path": "points.ply", "frames": frames,
    }  # fmt: skip
    yield "points.ply", enu_ply(pictures.run.cloud)
    yield "transforms.json", (json.dumps(transforms, indent=1) + "\n").encode()


def opengl_pose(picture: PlacedPicture) -> Array:
    """world_from_camera (4, 4): world east, north, up; camera right, up, backward."""
    pose = picture.pose.world_from_camera
    out = np.eye(4)
    out[:3, :3] = enu(pose.rotation.T).T * [1, -1, -1]
    out[:3, 3] = enu(pose.translation)
    return out


def enu_ply(cloud: Cloud) -> bytes:
    """Points and colours alone, east, north, up, as a binary PLY."""
    points = np.zeros(len(cloud), PLY_POINT)
    points["xyz"], points["rgb"] = enu(cloud.points.astype(np.float64)), cloud.rgb
    head = [
        "ply", "format binary_little_endian 1.0", "comment local east, north, up",
        f"element vertex {len(cloud)}", *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {channel}" for channel in ("red", "green", "blue")), "end_header",
    ]  # fmt: skip
    return ("\n".join(head) + "\n").encode() + points.tobytes()


def _name(picture: PlacedPicture) -> str:
    return f"frame_{picture.pose.t_ns}.jpg"


def _jpeg(rgb: Bytes) -> bytes:
    _, data = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return data.tobytes()


def _text(lines: list[str]) -> bytes:
    return ("\n".join(lines) + "\n").encode("ascii")
