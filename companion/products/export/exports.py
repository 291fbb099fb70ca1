"""Exports of a finished run, each file with a statement of its accuracy."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from companion import __version__
from companion.config import ExportConfig
from companion.errors import InputError
from companion.geometry.geodesy import GeoOrigin
from companion.products.atomic_file import write_atomically
from companion.products.export.accuracy import Axes, accuracy_statement, remarks_on_heights
from companion.products.export.cloud_copc import cloud_copc
from companion.products.export.cloud_las import cloud_las
from companion.products.export.cloud_pcd import cloud_pcd
from companion.products.export.flight_pictures import FlightPictures
from companion.products.export.image_mosaic import Mosaic, image_mosaic
from companion.products.export.map_frame import MapFrame, map_frame
from companion.products.export.mesh import Mesh, mesh_of
from companion.products.export.mesh_files import mesh_gltf, mesh_ply, textured_gltf
from companion.products.export.path_geo import path_geojson, path_gpx, path_kml
from companion.products.export.path_tables import path_euroc, path_kitti, times_kitti
from companion.products.export.reconstruction import MOST_TRACKED, colmap_files, nerfstudio_files
from companion.products.export.surface import Surface, surface_of
from companion.products.export.surface_tiff import mosaic_tiff, orthomosaic_tiff, surface_tiff
from companion.products.export.textured_mesh import TexturedMesh, textured_mesh
from companion.products.export.tileset import tileset_files
from companion.products.run_folder import FinishedRun


@dataclass(eq=False)
class Export:
    """A run to be exported; data that several formats need is made once."""

    run: FinishedRun
    config: ExportConfig
    flight: FlightPictures | None = None

    @cached_property
    def frame(self) -> MapFrame:
        """Coordinate frame of maps and clouds."""
        above_sea = not remarks_on_heights(self.run)
        return map_frame(self.run.origin, self.run.metric, self.config.epsg, above_sea)

    @cached_property
    def surface(self) -> Surface:
        """Height and colour rasters of the ground."""
        return surface_of(self.run.cloud, self.frame, self.config.cell_m)

    @cached_property
    def mesh(self) -> Mesh:
        """Surface mesh of the cloud."""
        return mesh_of(self.run.cloud, self.config.mesh_m)

    @cached_property
    def textured(self) -> TexturedMesh:
        """The same with the flight's pictures on it."""
        return textured_mesh(self.mesh, self.pictures)

    @cached_property
    def mosaic(self) -> Mosaic:
        """Orthomosaic of the flight's pictures."""
        if not self.run.metric:
            raise InputError(f"{self.run.path}: without a metric scale nothing tells what is up")
        return image_mosaic(self.pictures, self.surface, self.frame, self.config.cell_m)

    @property
    def pictures(self) -> FlightPictures:
        """Pictures of the flight; InputError where it is not given."""
        if self.flight is None:
            raise InputError(
                "colmap, nerfstudio, mosaic and textured need the pictures: --flight FLIGHT"
            )
        return self.flight

    @property
    def origin(self) -> GeoOrigin:
        """Geodetic origin; InputError where unknown."""
        if self.run.origin is None:
            raise InputError(
                f"{self.run.path}: no place on Earth is known of this run, so that gpx, kml, "
                "geojson and tiles cannot be had"
            )
        return self.run.origin

    @property
    def name(self) -> str:
        """Name of the run."""
        return self.run.path.resolve().name


class Product(NamedTuple):
    """Files of a format, each with its writer, and their coordinate frame.

    A format of many files has a `folder` instead, named as the format. `remarks` are lines for the
    statement of accuracy.
    """

    what: str
    files: Mapping[str, Callable[[Export], bytes]]
    axes: Axes = Axes.LOCAL
    remarks: Callable[[Export], list[str]] = lambda _: []
    folder: Callable[[Export], Iterator[tuple[str, bytes]]] | None = None


POSED = (
    "Pictures: undistorted, of a pinhole camera. Poses are those of the path; points are the dense "
    "cloud's."
)
TRACKED = (
    f"Up to {MOST_TRACKED} points have tracks: the pixels where pictures show them, by their "
    "poses. No feature was matched there."
)
PRODUCTS: Mapping[str, Product] = {
    "ply": Product(
        "cloud, local NED", {"cloud.ply": lambda e: (e.run.path / "cloud.ply").read_bytes()}
    ),
    "pcd": Product("cloud", {"cloud.pcd": lambda e: cloud_pcd(e.run.cloud, e.frame)}, Axes.MAP),
    "las": Product("cloud", {"cloud.las": lambda e: _las(e, packed=False)}, Axes.MAP),
    "laz": Product("cloud, packed", {"cloud.laz": lambda e: _las(e, packed=True)}, Axes.MAP),
    "copc": Product(
        "cloud, packed in an octree",
        {"cloud.copc.laz": lambda e: cloud_copc(e.run.cloud, e.frame)},
        Axes.MAP,
    ),
    "dsm": Product(
        "surface model, GeoTIFF",
        {"surface.tif": lambda e: surface_tiff(e.surface, e.frame)},
        Axes.MAP,
    ),
    "ortho": Product(
        "orthomosaic of the cloud, GeoTIFF",
        {"orthomosaic.tif": lambda e: orthomosaic_tiff(e.surface, e.frame)},
        Axes.MAP,
    ),
    "mosaic": Product(
        "orthomosaic of the pictures, GeoTIFF",
        {"mosaic.tif": lambda e: mosaic_tiff(e.mosaic, e.frame)},
        Axes.MAP,
        lambda e: _about_mosaic(e.mosaic),
    ),
    "glb": Product(
        "mesh, glTF",
        {"mesh.glb": lambda e: mesh_gltf(e.mesh)},
        Axes.GLTF,
        lambda e: _about_mesh(e.mesh, e.run),
    ),
    "mesh": Product(
        "mesh, PLY",
        {"mesh.ply": lambda e: mesh_ply(e.mesh)},
        Axes.LOCAL,
        lambda e: _about_mesh(e.mesh, e.run),
    ),
    "textured": Product(
        "mesh with the pictures on it, glTF",
        {"mesh_textured.glb": lambda e: textured_gltf(e.textured)},
        Axes.GLTF,
        lambda e: _about_mesh(e.mesh, e.run) + _about_textures(e.textured),
    ),
    "tiles": Product(
        "mesh on the Earth, 3D Tiles; with the pictures, if the flight is given",
        {},
        Axes.EARTH_CENTRED,
        lambda e: _about_mesh(e.mesh, e.run),
        lambda e: tileset_files(_tile(e), e.mesh.vertices, e.mesh.cell, e.origin),
    ),
    "colmap": Product(
        "pictures, poses and cloud for COLMAP",
        {},
        Axes.LOCAL,
        lambda _: [POSED, TRACKED],
        lambda e: colmap_files(e.pictures),
    ),
    "nerfstudio": Product(
        "the same for nerfstudio",
        {},
        Axes.EAST_NORTH_UP,
        lambda _: [POSED],
        lambda e: nerfstudio_files(e.pictures),
    ),
    "tum": Product(
        "path", {"trajectory.tum": lambda e: (e.run.path / "trajectory.tum").read_bytes()}
    ),
    "kitti": Product(
        "path",
        {
            "trajectory.kitti.txt": lambda e: path_kitti(e.run.poses),
            "trajectory.kitti.times.txt": lambda e: times_kitti(e.run.poses),
        },
        Axes.FIRST_CAMERA,
    ),
    "euroc": Product("path", {"trajectory.euroc.csv": lambda e: path_euroc(e.run.poses)}),
    "gpx": Product(
        "path",
        {"trajectory.gpx": lambda e: path_gpx(e.run.poses, e.origin, e.name)},
        Axes.EARTH,
    ),
    "kml": Product(
        "path",
        {"trajectory.kml": lambda e: path_kml(e.run.poses, e.origin, e.name)},
        Axes.EARTH,
    ),
    "geojson": Product(
        "path",
        {"trajectory.geojson": lambda e: path_geojson(e.run.poses, e.origin, e.name)},
        Axes.EARTH,
    ),
}


def export_run(
    run: FinishedRun, out: Path, config: ExportConfig, flight: FlightPictures | None = None
) -> list[Path]:
    """Write `config.formats` into folder `out`, each file with FILE.accuracy.txt beside it.

    All files are made before any is written, and those of a folder put there when it is whole.
    InputError for an unknown format, or one that this run cannot give; return the files and
    folders.
    """
    check_formats(config)
    export = Export(run, config, flight)
    made: list[tuple[Path, bytes]] = []
    folders: list[tuple[Path, Iterator[tuple[str, bytes]]]] = []
    for name in dict.fromkeys(config.formats):
        product = PRODUCTS[name]
        axes = export.frame if product.axes is Axes.MAP else product.axes
        if product.folder is not None:
            folders.append((out / name, product.folder(export)))
        for file, make in product.files.items():
            made.append((out / file, make(export)))
        for file in product.files or [name]:
            statement = accuracy_statement(run, file, axes, product.remarks(export))
            made.append((out / f"{file}.accuracy.txt", statement))
    try:
        out.mkdir(parents=True, exist_ok=True)
        for path, data in made:
            write_atomically(path, data)
        for folder, contents in folders:
            _write_folder(folder, contents)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from error
    files = [path for path, _ in made if not path.name.endswith(".accuracy.txt")]
    return files + [path for path, _ in folders]


def check_formats(config: ExportConfig) -> None:
    """InputError where a format is unknown."""
    for name in config.formats:
        if name not in PRODUCTS:
            raise InputError(f"unknown format {name!r}; known are {', '.join(PRODUCTS)}")


def _write_folder(folder: Path, files: Iterator[tuple[str, bytes]]) -> None:
    """Write files into a folder, which is there, in place of an older one, when all are."""
    part = folder.with_name(f".{folder.name}.part")
    try:
        shutil.rmtree(part, ignore_errors=True)
        for name, data in files:
            (part / name).parent.mkdir(parents=True, exist_ok=True)
            (part / name).write_bytes(data)
        shutil.rmtree(folder, ignore_errors=True)
        part.rename(folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _about_mesh(mesh: Mesh, run: FinishedRun) -> list[str]:
    unit = "m" if run.metric else "map units"
    return [
        f"Surface: {len(mesh.faces)} triangles in cells of {mesh.cell:g} {unit}, at the mean of "
        "the nearest points of the cloud; edges are rounded by about a cell. It ends where they do."
    ]


def _about_textures(textured: TexturedMesh) -> list[str]:
    return [
        f"Pictures: {len(textured.patches)}, on {100 * textured.share:.0f} % of the triangles; the "
        "others, which none shows, have the colours of the cloud. As bright as these, not blended."
    ]


def _tile(export: Export) -> bytes:
    return mesh_gltf(export.mesh) if export.flight is None else textured_gltf(export.textured)


def _about_mosaic(mosaic: Mosaic) -> list[str]:
    return [
        f"Mosaic: of {mosaic.n_pictures} pictures, cells of {mosaic.cell_m:g} m, on the surface of "
        "the cloud: where that is wrong by h, a place seen at an angle a from above is off by "
        "h tan a. Brightness is that of the pictures, blended, not calibrated."
    ]


def _las(export: Export, *, packed: bool) -> bytes:
    return cloud_las(export.run.cloud, export.frame, packed, f"companion {__version__}")
