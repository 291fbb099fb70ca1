"""Exports of a known run, read back by the formats' own libraries."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import laspy
import numpy as np
import pytest
import rasterio
from pyproj import CRS, Transformer

from companion.app.cli import main
from companion.config import ExportConfig
from companion.errors import InputError
from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Pose, quaternion_from_euler, rotation_from_quaternion
from companion.products.cloud import Cloud
from companion.products.cloud_ply import ply_parts
from companion.products.export.cloud_copc import octree
from companion.products.export.exports import PRODUCTS, export_run
from companion.products.export.map_frame import map_frame
from companion.products.export.surface import surface_of
from companion.products.flight_result import WorldPose
from companion.products.run_folder import FinishedRun, read_run
from companion.products.trajectory_file import trajectory_tum

ORIGIN = GeoOrigin(47.3977, 8.5456, 488.125)
T0_NS = 1_762_000_000_123_456_789
GREY = [90, 100, 110]
RED_POINT_NED = np.array([70.0, -30.0, -12.5])
"""North, west and up: each axis with a value of its own."""


def ground() -> Cloud:
    """A field of 60 m by 40 m, grey, 3 m below the origin, and one red point."""
    north, east = np.meshgrid(np.arange(0, 60, 0.5), np.arange(0, 40, 0.5), indexing="ij")
    points = np.stack([north.ravel(), east.ravel(), np.full(north.size, 3.0)], 1)
    points = np.vstack([points, RED_POINT_NED]).astype(np.float32)
    rgb = np.tile(np.array(GREY, np.uint8), (len(points), 1))
    rgb[-1] = [250, 20, 5]
    confidence = np.full(len(points), 0.5, np.float32)
    confidence[-1] = 0.875
    normals = np.tile(np.array([0, 0, -1], np.float32), (len(points), 1))
    normals[-1] = [0.6, 0.8, 0]
    sigma = np.full(len(points), 0.25, np.float32)
    sigma[-1] = 0.125
    return Cloud(points, rgb, confidence, normals, sigma)


def poses() -> list[WorldPose]:
    out = []
    for k in range(5):
        turn = rotation_from_quaternion(quaternion_from_euler(0.1 * k, -0.4, 1.0 + 0.2 * k))
        place = np.array([10.0 * k, -3.0 * k, -20.0 - k])
        out.append(WorldPose(k, T0_NS + k * 100_000_000, Pose(turn, place)))
    return out


def write_run(folder: Path, origin: GeoOrigin | None = ORIGIN, unit: str = "m") -> FinishedRun:
    folder.mkdir(exist_ok=True)
    report = {
        "unit": unit, "frames": 6, "tracked": 5, "clock": None, "camera": {"assumed": False},
        "origin": origin and {
            "latitude_deg": origin.latitude_deg, "longitude_deg": origin.longitude_deg,
            "altitude_m": origin.altitude_m,
        },
        "scale": {
            "method": "local position", "sigma_relative": 0.01, "sigma_yaw_deg": 0.5,
            "positions": 80, "residual_m": 0.25,
        },
    }  # fmt: skip
    (folder / "report.json").write_text(json.dumps(report))
    (folder / "cloud.ply").write_bytes(b"".join(ply_parts(ground(), unit, origin)))
    (folder / "trajectory.tum").write_bytes(trajectory_tum(poses(), unit, origin))
    return read_run(folder)


@pytest.fixture
def run(tmp_path: Path) -> FinishedRun:
    return write_run(tmp_path / "run")


def exported(run: FinishedRun, out: Path, *formats: str, **changes: Any) -> list[Path]:
    return export_run(run, out, replace(ExportConfig(formats=formats), **changes))


def red_place() -> tuple[float, float, float]:
    """Where on Earth the red point is, by PROJ's topocentric arithmetic."""
    pipeline = Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0={ORIGIN.latitude_deg} "
        f"+lon_0={ORIGIN.longitude_deg} +h_0={ORIGIN.altitude_m} "
        "+step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    north, east, down = RED_POINT_NED
    longitude, latitude, height = pipeline.transform(east, north, -down)
    return latitude, longitude, height


def test_run_reads_back(run: FinishedRun) -> None:
    assert run.metric
    assert run.origin == ORIGIN
    assert (run.cloud.rgb[-1] == [250, 20, 5]).all()
    assert (run.cloud.points == ground().points).all()
    assert (run.cloud.normals == ground().normals).all()
    assert (run.cloud.sigma == ground().sigma).all()
    assert [pose.t_ns for pose in run.poses] == [pose.t_ns for pose in poses()]
    for one, other in zip(run.poses, poses(), strict=True):
        np.testing.assert_allclose(
            one.world_from_camera.matrix(), other.world_from_camera.matrix(), atol=1e-6
        )


@pytest.mark.parametrize("kind", ["las", "laz"])
def test_cloud_lies_at_its_place_on_earth(run: FinishedRun, tmp_path: Path, kind: str) -> None:
    """The red point, back from the file's projection to latitude and longitude by PROJ."""
    (path,) = exported(run, tmp_path, kind)
    las = laspy.read(path)
    crs = las.header.parse_crs()
    assert crs is not None
    assert crs.sub_crs_list[0].to_epsg() == 32632
    assert crs.sub_crs_list[1].to_epsg() == 5773
    back = Transformer.from_crs(32632, 4326, always_xy=True)
    red = int(np.argmax(las.red))
    longitude, latitude = back.transform(las.x[red], las.y[red])
    true_latitude, true_longitude, true_height = red_place()
    assert latitude == pytest.approx(true_latitude, abs=1e-8)
    assert longitude == pytest.approx(true_longitude, abs=1.5e-8)
    assert las.z[red] == pytest.approx(true_height, abs=1e-3)
    assert (las.red[red], las.green[red], las.blue[red]) == (250 * 257, 20 * 257, 5 * 257)
    assert las.confidence[red] == 0.875
    assert las.sigma[red] == 0.125
    # 0.6 north, 0.8 east, where grid north is turned from true north by half a degree
    facing = [float(v[red]) for v in (las.normal_x, las.normal_y, las.normal_z)]
    latitude_rad = math.radians(ORIGIN.latitude_deg)
    meridian = math.radians((ORIGIN.longitude_deg - 9) * math.sin(latitude_rad))
    c, s = math.cos(meridian), math.sin(meridian)
    wanted = [0.8 * c - 0.6 * s, 0.6 * c + 0.8 * s, 0]
    np.testing.assert_allclose(facing, wanted, atol=2e-4)
    assert len(las.x) == len(run.cloud)
    assert path.read_bytes()[:4] == b"LASF"


def test_cloud_in_a_given_projection(run: FinishedRun, tmp_path: Path) -> None:
    """Swiss coordinates, LV95."""
    (path,) = exported(run, tmp_path, "las", epsg=2056)
    las = laspy.read(path)
    red = int(np.argmax(las.red))
    latitude, longitude, _ = red_place()
    east, north = Transformer.from_crs(4326, 2056, always_xy=True).transform(longitude, latitude)
    assert las.x[red] == pytest.approx(east, abs=2e-3)
    assert las.y[red] == pytest.approx(north, abs=2e-3)
    assert "EPSG:2056" in (tmp_path / "cloud.las.accuracy.txt").read_text()


@pytest.mark.parametrize(
    ("epsg", "why"), [(4326, "no flat projection"), (999_998, "no such"), (4978, "no flat"),
                      (2263, "no flat projection in metres")],
)  # fmt: skip
def test_projection_that_will_not_do(run: FinishedRun, tmp_path: Path, epsg: int, why: str) -> None:
    with pytest.raises(InputError, match=why):
        exported(run, tmp_path / "out", "las", epsg=epsg)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("latitude", "longitude", "name", "epsg"),
    [
        (-35.36, 149.17, "WGS 84 / UTM zone 55S", 32755),
        (47.4, 8.55, "WGS 84 / UTM zone 32N", 32632),
        (60.39, 5.32, "WGS 84 / UTM zone 32N", 32632),
        (78.2, 15.6, "WGS 84 / UTM zone 33N", 32633),
        (0.0, -180.0, "WGS 84 / UTM zone 1N", 32601),
        (10.0, 180.0, "WGS 84 / UTM zone 1N", 32601),
        (-0.1, 179.9, "WGS 84 / UTM zone 60S", 32760),
    ],
)
def test_zones(latitude: float, longitude: float, name: str, epsg: int) -> None:
    """Canberra, Zurich, Bergen and Spitsbergen; the last two have zones by exception."""
    frame = map_frame(GeoOrigin(latitude, longitude, 0), True, 0)
    assert (frame.name, frame.epsg) == (name, epsg)
    east, north, up = frame.coordinates(np.zeros((1, 3)))[0]
    back = Transformer.from_crs(epsg, 4326).transform(east, north)
    np.testing.assert_allclose([*back, up], [latitude, (longitude + 180) % 360 - 180, 0], atol=1e-9)


def test_no_zone_at_the_poles() -> None:
    with pytest.raises(InputError, match="give an EPSG number"):
        map_frame(GeoOrigin(85.0, 10.0, 0), True, 0)


def read_pcd(path: Path) -> tuple[list[str], Any]:
    head, _, body = path.read_bytes().partition(b"DATA binary\n")
    lines = head.decode().splitlines()
    fields, kinds = ([*line.split()[1:]] for line in lines if line.startswith(("FIELDS", "TYPE")))
    kind = {"F": "<f4", "U": "<u4"}
    layout = np.dtype([(name, kind[k]) for name, k in zip(fields, kinds, strict=True)])
    return lines, np.frombuffer(body, layout)


def test_pcd(run: FinishedRun, tmp_path: Path) -> None:
    exported(run, tmp_path, "pcd", "las")
    head, points = read_pcd(tmp_path / "cloud.pcd")
    las = laspy.read(tmp_path / "cloud.las")
    shift = np.array(head[2].split(":")[1].split(), np.float64)
    here = np.array([points["x"][-1], points["y"][-1], points["z"][-1]], np.float64) + shift
    np.testing.assert_allclose(here, [las.x[-1], las.y[-1], las.z[-1]], atol=1.5e-3)
    assert points["rgb"][-1] == 250 << 16 | 20 << 8 | 5
    assert points["sigma"][-1] == 0.125
    facing = [points[f"normal_{axis}"][-1] for axis in "xyz"]
    np.testing.assert_allclose(facing, [las.normal_x[-1], las.normal_y[-1], las.normal_z[-1]])
    assert f"POINTS {len(points)}" in head


def test_surface_model(run: FinishedRun, tmp_path: Path) -> None:
    exported(run, tmp_path, "dsm", "ortho")
    latitude, longitude, height = red_place()
    east, north = Transformer.from_crs(4326, 32632, always_xy=True).transform(longitude, latitude)
    with rasterio.open(tmp_path / "surface.tif") as dsm:
        assert dsm.crs.to_epsg() == 32632
        assert dsm.res == (1.0, 1.0)
        assert next(dsm.sample([(east, north)]))[0] == pytest.approx(height, abs=1e-3)
        heights = dsm.read(1, masked=True)
        level = float(np.median(heights.compressed()))
        assert level == pytest.approx(ORIGIN.altitude_m - 3, abs=0.01)
        assert 2400 < heights.count() < 2900
        assert next(dsm.sample([(east + 10, north)]))[0] == -9999
    with rasterio.open(tmp_path / "orthomosaic.tif") as ortho:
        assert list(next(ortho.sample([(east, north)]))) == [250, 20, 5, 255]
        assert list(next(ortho.sample([(east + 10, north)]))) == [0, 0, 0, 0]


def test_octree_of_points(run: FinishedRun, tmp_path: Path) -> None:
    """Read by laspy, by levels of detail: the coarse ones are spread over all, none is lost."""
    (path,) = exported(run, tmp_path, "copc")
    with laspy.open(path) as file:
        (wkt,) = [vlr for vlr in file.evlrs or [] if vlr.record_id == 2112]
    crs = CRS.from_wkt(wkt.record_data_bytes().decode())
    assert crs.sub_crs_list[0].to_epsg() == 32632
    with laspy.CopcReader.open(str(path)) as reader:
        every = reader.query()
        coarse = reader.query(level=0)
        info = reader.copc_info
    assert len(every.x) == len(run.cloud) == reader.header.point_count
    red = int(np.argmax(every.red))
    latitude, longitude, height = red_place()
    east, north = Transformer.from_crs(4326, 32632, always_xy=True).transform(longitude, latitude)
    np.testing.assert_allclose(
        [every.x[red], every.y[red], every.z[red]], [east, north, height], atol=2e-3
    )
    assert (every.red[red], every.intensity[red]) == (250 * 257, round(0.875 * 65535))
    places = np.sort(np.column_stack([every.x, every.y, every.z]), axis=0)
    exported(run, tmp_path, "las")
    las = laspy.read(tmp_path / "cloud.las")
    np.testing.assert_allclose(places, np.sort(las.xyz, axis=0), atol=1.5e-3)
    assert 0 < len(coarse.x) <= len(every.x)
    assert info.spacing == pytest.approx(2 * info.halfsize / 128)


def test_nodes_have_one_point_a_cell(rng: np.random.Generator) -> None:
    places = rng.uniform(0, 1, (60_000, 3)) * [1, 1, 0.001]
    nodes = dict(octree(places))
    index = np.concatenate(list(nodes.values()))
    assert sorted(index) == list(range(60_000))
    assert len(nodes[0, 0, 0, 0]) > 0.9 * 128**2
    for (depth, x, y, z), inside in nodes.items():
        within = places[inside] * 2**depth - [x, y, z]
        assert ((within >= 0) & (within < 1)).all()
        assert len(np.unique(np.floor(within * 128), axis=0)) == len(inside)
        assert depth == 0 or (depth - 1, x // 2, y // 2, z // 2) in nodes


def test_walls_do_not_make_the_cells_finer_than_the_ground(rng: np.random.Generator) -> None:
    """Seen from above four walls of 200 000 points have next to no area."""
    ground = np.stack([*np.meshgrid(np.arange(-30, 30, 0.2), np.arange(-30, 30, 0.2))], -1)
    ground = ground.reshape(-1, 2) + rng.normal(0, 0.01, (ground.size // 2, 2))
    along, up = rng.uniform(-10, 10, 200_000), rng.uniform(-12, 0, 200_000)
    side = rng.choice([-10.0, 10.0], 200_000)
    walls = np.stack([along, side, up], -1)
    walls[::2, :2] = walls[::2, 1::-1]
    points = np.concatenate([np.column_stack([ground, np.zeros(len(ground))]), walls])
    n = len(points)
    cloud = Cloud(
        points.astype(np.float32), np.full((n, 3), 90, np.uint8), np.ones(n, np.float32),
        np.zeros((n, 3), np.float32), np.full(n, np.nan, np.float32),
    )  # fmt: skip
    surface = surface_of(cloud, map_frame(None, True, 0, True), 0.0)
    assert 0.3 < surface.cell_m < 0.5
    assert np.isfinite(surface.height).mean() > 0.98


def test_cells_are_not_too_many(run: FinishedRun, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"set expert\.export\.cell_m"):
        exported(run, tmp_path, "dsm", cell_m=1e-4)


def test_paths_of_places(run: FinishedRun, tmp_path: Path) -> None:
    exported(run, tmp_path, "gpx", "kml", "geojson")
    gpx = ElementTree.parse(tmp_path / "trajectory.gpx").getroot()
    space = "{http://www.topografix.com/GPX/1/1}"
    points = gpx.findall(f".//{space}trkpt")
    assert len(points) == 5
    last = points[-1]
    # 40 m north and 12 m west, by the length of a degree
    latitude, longitude = float(last.attrib["lat"]), float(last.attrib["lon"])
    assert (latitude - ORIGIN.latitude_deg) * 111_175 == pytest.approx(40, abs=0.05)
    metres = 111_320 * math.cos(math.radians(ORIGIN.latitude_deg)) * 1.0018
    assert (longitude - ORIGIN.longitude_deg) * metres == pytest.approx(-12, abs=0.05)
    assert float(last.findtext(f"{space}ele") or 0) == pytest.approx(488.125 + 24, abs=0.001)
    assert last.findtext(f"{space}time") == "2025-11-01T12:26:40.523Z"
    kml = (tmp_path / "trajectory.kml").read_text()
    assert f"{longitude:.9f},{latitude:.9f},512.125" in kml
    (feature,) = json.loads((tmp_path / "trajectory.geojson").read_text())["features"]
    assert feature["geometry"]["coordinates"][-1] == [longitude, latitude, 512.125]


def test_paths_for_programs(run: FinishedRun, tmp_path: Path) -> None:
    exported(run, tmp_path, "kitti", "euroc", "tum")
    first_from_last = (
        poses()[0].world_from_camera.inverse() @ poses()[-1].world_from_camera
    ).matrix()[:3]
    kitti = np.loadtxt(tmp_path / "trajectory.kitti.txt")
    np.testing.assert_allclose(kitti[0], np.eye(4)[:3].ravel(), atol=1e-6)
    np.testing.assert_allclose(kitti[-1], first_from_last.ravel(), atol=1e-6)
    np.testing.assert_allclose(
        np.loadtxt(tmp_path / "trajectory.kitti.times.txt"), np.arange(5) * 0.1, atol=1e-6
    )
    euroc = (tmp_path / "trajectory.euroc.csv").read_text().splitlines()[-1].split(",")
    assert int(euroc[0]) == poses()[-1].t_ns
    turn = rotation_from_quaternion(np.array([float(v) for v in euroc[4:]]))
    np.testing.assert_allclose(turn, poses()[-1].world_from_camera.rotation, atol=1e-6)
    same = (run.path / "trajectory.tum").read_bytes()
    assert (tmp_path / "trajectory.tum").read_bytes() == same


def test_accuracy_beside_each_file(run: FinishedRun, tmp_path: Path) -> None:
    made = exported(
        run, tmp_path, *(set(PRODUCTS) - {"mosaic", "textured", "colmap", "nerfstudio"})
    )
    for path in made:
        text = path.with_name(path.name + ".accuracy.txt").read_text()
        assert path.name in text
        assert "1.00 %" in text
        assert "47.39770000" in text
        assert "no better than the autopilot's own" in text
    for name, axes in {
        "surface.tif": "(EPSG:32632)", "cloud.ply": "local north, east, down",
        "trajectory.kitti.txt": "of the first camera", "trajectory.gpx": "latitude and longitude",
        "trajectory.geojson": "not above the ellipsoid",
    }.items():  # fmt: skip
        assert axes in (tmp_path / f"{name}.accuracy.txt").read_text()


def test_heights_that_are_not_above_the_sea(tmp_path: Path) -> None:
    """They are not given out as such."""
    run = write_run(tmp_path / "run")
    what = "heights of NavSatFix are above the ellipsoid"
    told = {**run.report, "warnings": [{"what": what, "count": 1, "first_detail": "so"}]}
    path, _, _ = exported(replace(run, report=told), tmp_path, "las", "gpx", "ply")
    crs = laspy.read(path).header.parse_crs()
    assert crs is not None
    assert crs.to_epsg() == 32632
    for name in ("cloud.las", "trajectory.gpx", "cloud.ply"):
        text = (tmp_path / f"{name}.accuracy.txt").read_text()
        assert "NOT above mean sea level. heights of NavSatFix" in text
        assert "m above mean sea level" not in text


def test_times_that_are_of_no_day(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    what = "no frames.csv: times are the file's own"
    told = {
        **run.report, "warnings": [{"what": what, "count": 1, "first_detail": "counted from zero"}],
        "clock": {"method": "rotation of the pictures", "offset_s": -1762e6, "sigma_ms": 1.0},
    }  # fmt: skip
    exported(replace(run, report=told), tmp_path, "gpx")
    text = (tmp_path / "trajectory.gpx.accuracy.txt").read_text()
    assert "Times are the video's own, counted from zero" in text
    assert "The log's are these less -1762000000.000 s." in text
    assert "recording computer" not in text


@pytest.mark.parametrize("formats", [("gpx",), ("las", "kml"), ("geojson",)])
def test_no_place_on_earth(tmp_path: Path, formats: Sequence[str]) -> None:
    run = write_run(tmp_path / "run", origin=None)
    with pytest.raises(InputError, match="no place on Earth"):
        exported(run, tmp_path / "out", *formats)
    assert not (tmp_path / "out").exists()


def test_local_coordinates(tmp_path: Path) -> None:
    """East, north, up about the start, and no projection that would be a lie."""
    run = write_run(tmp_path / "run", origin=None)
    (path,) = exported(run, tmp_path, "laz")
    las = laspy.read(path)
    assert [las.x[-1], las.y[-1], las.z[-1]] == [-30.0, 70.0, 12.5]
    assert las.header.parse_crs() is None
    text = (tmp_path / "cloud.laz.accuracy.txt").read_text()
    assert "Coordinates: local east, north, up in metres." in text
    with pytest.raises(InputError, match="EPSG:32632 cannot be had"):
        exported(run, tmp_path, "laz", epsg=32632)


def test_no_scale(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", unit="map units")
    (path,) = exported(run, tmp_path, "las")
    las = laspy.read(io.BytesIO(path.read_bytes()))
    assert [las.x[-1], las.y[-1], las.z[-1]] == [70.0, -30.0, -12.5]
    assert "No metric scale" in (tmp_path / "cloud.las.accuracy.txt").read_text()


def test_unknown_format(run: FinishedRun, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unknown format 'dwg'"):
        exported(run, tmp_path, "las", "dwg")


@pytest.mark.parametrize(
    ("name", "content", "named"),
    [
        ("report.json", b"{", "JSON"),
        ("report.json", b"[]", "no report"),
        ("report.json", b'{"unit": "m", "origin": {"latitude_deg": 1}}', "no place"),
        ("trajectory.tum", b"1.5 0 0 0 0 0 0 0\n", "line 1"),
        ("trajectory.tum", b"1.5 0 0 0 0 0 1\n", "line 1"),
        ("trajectory.tum", b"\xff\xfe\n", "line 1"),
        ("cloud.ply", b"ply\nend_header\n", "not a cloud"),
        ("cloud.ply", None, "missing"),
    ],
)
def test_run_that_is_damaged(tmp_path: Path, name: str, content: bytes | None, named: str) -> None:
    write_run(tmp_path)
    if content is None:
        (tmp_path / name).unlink()
    else:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=named):
        read_run(tmp_path)


def test_cloud_cut_short(tmp_path: Path) -> None:
    write_run(tmp_path)
    whole = (tmp_path / "cloud.ply").read_bytes()
    (tmp_path / "cloud.ply").write_bytes(whole[:-5])
    with pytest.raises(InputError, match="cut short"):
        read_run(tmp_path)


def test_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_run(tmp_path / "run")
    run, out = str(tmp_path / "run"), tmp_path / "out"
    assert main(["export", run, "--as", "las, GPX", "--out", str(out)]) == 0
    assert capsys.readouterr().out == f"export: {out}/cloud.las\nexport: {out}/trajectory.gpx\n"
    assert len(list(out.iterdir())) == 4
    assert main(["export", run, "--set", 'expert.export.formats=["kml"]']) == 0
    assert (tmp_path / "run" / "trajectory.kml").exists()
    assert main(["export", run]) == 2
    assert main(["export", run, "--as", "dwg"]) == 2
    assert main(["export", str(tmp_path / "nowhere"), "--as", "las"]) == 2
    assert "nothing to export" in capsys.readouterr().err
