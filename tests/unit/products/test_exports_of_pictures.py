"""Exports that need the flight's pictures: a plane of known colours, seen from above."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pyproj
import pytest
import rasterio
import trimesh
from PIL import Image

from companion.config import ExportConfig
from companion.errors import InputError
from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin, geodetic_from_ned
from companion.geometry.transforms import Array, Pose, quaternion_from_euler
from companion.geometry.transforms import rotation_from_quaternion as rotation
from companion.messages import Bytes
from companion.products.cloud import Cloud, joined
from companion.products.export.exports import export_run
from companion.products.export.flight_pictures import FlightPictures
from companion.products.export.map_frame import map_frame
from companion.products.flight_result import WorldPose
from companion.products.run_folder import FinishedRun

GROUND_M = 5.0
"""Down."""
CAMERA = Camera(320, 240, 200.0, 200.0, 159.5, 119.5)
DOWN = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
"""World from a camera that looks down, its right to the east."""
ORIGIN = GeoOrigin(47.3977, 8.5456, 488.0)


def colours(places: Array) -> Bytes:
    """Of the ground at north and east (..., 2): smooth, and each place of its own."""
    north, east = places[..., 0], places[..., 1]
    red = 128 + 60 * np.sin(north * 0.9)
    green = 128 + 60 * np.cos(east * 0.7 + 0.2 * north)
    return np.stack([red, green, 100 + 3 * east], -1).astype(np.uint8)


def pose(k: int) -> WorldPose:
    turn = rotation(quaternion_from_euler(0.05 * (-1) ** k, 0.1, 0.2 * k))
    return WorldPose(k, 10**9 * k, Pose(turn @ DOWN, np.array([2.0 * k, 0.5 * k, -15.0])))


def picture(k: int) -> Bytes:
    """What a camera there sees of the ground, exactly."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(np.float64)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], -1)
    there = pose(k).world_from_camera
    rays = rays @ there.rotation.T
    depth = (GROUND_M - there.translation[2]) / rays[..., 2]
    return colours((there.translation + depth[..., None] * rays)[..., :2])


@pytest.fixture
def run(tmp_path: Path) -> FinishedRun:
    north, east = np.meshgrid(np.arange(-5, 17, 0.25), np.arange(-9, 12, 0.25), indexing="ij")
    points = np.stack([north.ravel(), east.ravel(), np.full(north.size, GROUND_M)], 1)
    n = len(points)
    cloud = Cloud(
        points.astype(np.float32), np.full((n, 3), 7, np.uint8), np.ones(n, np.float32),
        np.tile(np.array([0, 0, -1], np.float32), (n, 1)), np.full(n, 0.1, np.float32),
    )  # fmt: skip
    said = {
        "width": 320, "height": 240, "fx": 200.0, "fy": 200.0, "cx": 159.5, "cy": 119.5,
        "distortion": "none", "coefficients": [], "assumed": False,
    }  # fmt: skip
    report = {"unit": "m", "frames": 6, "tracked": 6, "camera": said}
    return FinishedRun(tmp_path / "run", [pose(k) for k in range(6)], cloud, report, True, ORIGIN)


def flight(run: FinishedRun, least: int = 0) -> FlightPictures:
    def frames(wanted: Collection[int]) -> Iterator[tuple[int, Bytes]]:
        for t_ns in sorted(wanted):
            if t_ns >= least:
                yield t_ns, picture(t_ns // 10**9)

    return FlightPictures(run, Path("flight"), frames)


def check_colour(path: Path, pixel: Array, place: Array) -> None:
    """A picture has the ground's colour of a place at a pixel (2,), where it sees that."""
    shown = Image.open(path)
    assert shown.size == (320, 240)
    if (pixel > 2).all() and (pixel < [317, 237]).all():
        seen = np.array(shown.getpixel((round(float(pixel[0])), round(float(pixel[1])))))
        assert np.abs(seen - colours(place[:2]).astype(int)).max() < 12  # JPEG


def test_mosaic_has_the_colours_of_the_ground(run: FinishedRun, tmp_path: Path) -> None:
    """Each cell against the ground at its place on Earth."""
    (path,) = export_run(run, tmp_path, ExportConfig(formats=("mosaic",)), flight(run))
    frame = map_frame(ORIGIN, True, 0)
    with rasterio.open(path) as raster:
        assert raster.crs.to_epsg() == 32632
        assert raster.res[0] == pytest.approx(0.1, rel=0.02)  # 20 m by 200 px
        bands = raster.read()
        rows, columns = np.nonzero(bands[3])
        east, north = raster.xy(rows, columns)
    ned_zero = frame.coordinates(np.zeros((1, 3)))[0]
    slopes = np.array(frame.coordinates(np.eye(3)) - ned_zero)[:2, :2]
    places = np.stack([np.array(east) - ned_zero[0], np.array(north) - ned_zero[1]], 1)
    ned = places @ np.linalg.inv(slopes)
    assert len(ned) > 0.75 * 220 * 210
    off = np.abs(bands[:3, rows, columns].T.astype(int) - colours(ned).astype(int))
    # half a pixel of the steepest colour is 3; the blending adds its rounding
    assert np.quantile(off, 0.99) <= 4
    text = (tmp_path / "mosaic.tif.accuracy.txt").read_text()
    assert "of 6 pictures, cells of 0.1 m" in text


def test_textured_mesh_shows_the_ground(run: FinishedRun, tmp_path: Path) -> None:
    """A triangle's picture has the ground's colours at its corners."""
    run = replace(
        run, cloud=replace(run.cloud, rgb=colours(run.cloud.points[:, :2].astype(np.float64)))
    )
    (path,) = export_run(run, tmp_path, ExportConfig(formats=("textured",)), flight(run))
    scene: Any = trimesh.load(path)
    off, n_faces, n_pictured = [], 0, 0
    for part in scene.geometry.values():
        n_faces += len(part.faces)
        image = getattr(part.visual, "material", None)
        if image is None:
            continue
        n_pictured += len(part.faces)
        texture = np.asarray(image.baseColorTexture)
        places = part.visual.uv * [1, -1] + [0, 1]
        columns, rows = (places * [CAMERA.width, CAMERA.height]).astype(int).T
        ned = np.stack([-part.vertices[:, 2], part.vertices[:, 0]], 1)
        off.append(np.abs(texture[rows, columns].astype(int) - colours(ned).astype(int)))
    assert n_pictured > 0.7 * n_faces
    # half a pixel of the steepest colour is 3; JPEG and the gain add some
    assert np.quantile(np.concatenate(off), 0.95) <= 12
    text = (tmp_path / "mesh_textured.glb.accuracy.txt").read_text()
    assert f"on {100 * n_pictured / n_faces:.0f} % of the triangles" in text


def test_tile_lies_on_the_earth(run: FinishedRun, tmp_path: Path) -> None:
    """Its middle, brought to the Earth by its transform, is that of the cloud."""
    (folder,) = export_run(run, tmp_path, ExportConfig(formats=("tiles",)))
    root = json.loads((folder / "tileset.json").read_text())["root"]
    earth_from_enu = np.array(root["transform"]).reshape(4, 4).T
    middle = earth_from_enu @ [*root["boundingVolume"]["box"][:3], 1.0]
    to_geodetic = pyproj.Transformer.from_crs(4978, 4979, always_xy=True)
    longitude, latitude, height = to_geodetic.transform(*middle[:3])
    places = run.cloud.points.astype(np.float64)
    wanted = geodetic_from_ned((places.min(0) + places.max(0))[None] / 2, ORIGIN)[0]
    assert [latitude, longitude] == pytest.approx(wanted[:2], abs=3e-6)  # 0.3 m: a cell
    assert height == pytest.approx(ORIGIN.altitude_m - GROUND_M, abs=0.2)
    scene: Any = trimesh.load(folder / root["content"]["uri"])
    assert scene.geometry


def test_colmap_reads_its_model(run: FinishedRun, tmp_path: Path) -> None:
    """A point of the ground is at the pixel, with COLMAP's arithmetic, that our camera has."""
    (folder,) = export_run(run, tmp_path, ExportConfig(formats=("colmap",)), flight(run))
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    assert len(model.points3D) == len(run.cloud)
    assert len(model.images) == 6
    place = np.array([4.0, 1.0, GROUND_M])
    for image in model.images.values():
        k = int(image.name.removeprefix("frame_").removesuffix(".jpg")) // 10**9
        pixel = image.project_point(place)
        ours = CAMERA.project(pose(k).world_from_camera.inverse().apply(place[None]))[0]
        np.testing.assert_allclose(pixel, ours + 0.5, atol=1e-5)
        check_colour(folder / "images" / image.name, ours, place)
    told = (tmp_path / "colmap.accuracy.txt").read_text()
    assert "the pixels where pictures show them" in told


def test_tracks_of_colmap_are_what_pictures_show(run: FinishedRun, tmp_path: Path) -> None:
    """A roof hides the ground below it, and nothing shows the underside of another."""
    ground = run.cloud
    below = np.abs(ground.points[:, :2] - [4.0, 1.0]).max(1) <= 1.0
    part = ground.part(below)
    roof = replace(part, points=part.points + np.array([0, 0, -2], np.float32))
    above = np.array([4, 0, -2], np.float32)
    ceiling = replace(part, points=part.points + above, normals=-part.normals)
    run = replace(run, cloud=joined([ground, roof, ceiling]))
    (folder,) = export_run(run, tmp_path, ExportConfig(formats=("colmap",)), flight(run))
    model = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    lengths = np.array([model.points3D[i + 1].track.length() for i in range(len(run.cloud))])
    on_roof = np.arange(len(ground), len(ground) + len(roof))
    assert lengths[on_roof].min() >= 2
    assert not lengths[on_roof[-1] + 1 :].any()
    inner = np.abs(ground.points[:, :2] - [4.0, 1.0]).max(1) <= 0.25
    assert not lengths[: len(ground)][inner].any()
    assert lengths.max() == 6 and 1 not in lengths
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 0.01
    for image in model.images.values():
        seen = [each for each in image.points2D if each.has_point3D()]
        assert len(seen) == len(image.points2D) > 100


def test_nerfstudio_has_cameras_in_the_axes_of_opengl(run: FinishedRun, tmp_path: Path) -> None:
    (folder,) = export_run(run, tmp_path, ExportConfig(formats=("nerfstudio",)), flight(run))
    told = json.loads((folder / "transforms.json").read_text())
    assert len(told["frames"]) == 6
    place = np.array([1.0, 4.0, -GROUND_M, 1.0])  # east, north, up
    for frame in told["frames"]:
        assert (folder / frame["file_path"]).exists()
        k = int(frame["file_path"].rpartition("_")[2].removesuffix(".jpg")) // 10**9
        x, y, z, _ = np.linalg.inv(frame["transform_matrix"]) @ place
        # OpenGL looks along -z, y up; image v goes down
        pixel = [told["fl_x"] * x / -z + told["cx"], told["fl_y"] * -y / -z + told["cy"]]
        ned = np.array([4.0, 1.0, GROUND_M])
        ours = CAMERA.project(pose(k).world_from_camera.inverse().apply(ned[None]))[0]
        np.testing.assert_allclose(pixel, ours + 0.5, atol=1e-6)
        check_colour(folder / frame["file_path"], ours, ned)
    head, _, body = (folder / told["ply_file_path"]).read_bytes().partition(b"end_header\n")
    assert f"element vertex {len(run.cloud)}".encode() in head
    first = np.frombuffer(body, "<f4", 3)
    np.testing.assert_allclose(first, run.cloud.points[0][[1, 0, 2]] * [1, 1, -1])


@pytest.mark.parametrize("name", ["mosaic", "colmap", "nerfstudio"])
def test_pictures_are_needed(run: FinishedRun, tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="--flight FLIGHT"):
        export_run(run, tmp_path, ExportConfig(formats=(name,)))
    assert not list(tmp_path.iterdir())
    other = flight(run, least=10**12)
    with pytest.raises(InputError, match="is it the flight that was replayed"):
        export_run(run, tmp_path, ExportConfig(formats=(name,)), other)
    assert not (tmp_path / name).exists()


def test_pictures_of_another_camera_are_refused(run: FinishedRun, tmp_path: Path) -> None:
    camera = {**run.report["camera"], "width": 640}
    other = replace(run, report={**run.report, "camera": camera})
    with pytest.raises(InputError, match="320 x 240"):
        export_run(other, tmp_path, ExportConfig(formats=("colmap",)), flight(other))
    blind = replace(run, report={"unit": "m"})
    with pytest.raises(InputError, match="does not tell the camera"):
        export_run(blind, tmp_path, ExportConfig(formats=("colmap",)), flight(blind))
