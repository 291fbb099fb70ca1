"""Exports of a finished run, each file with a statement of its accuracy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
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
from companion.products.export.cloud_las import cloud_las
from companion.products.export.cloud_pcd import cloud_pcd
from companion.products.export.map_frame import MapFrame, map_frame
from companion.products.export.path_geo import path_geojson, path_gpx, path_kml
from companion.products.export.path_tables import path_euroc, path_kitti, times_kitti
from companion.products.export.surface import Surface, surface_of
from companion.products.export.surface_tiff import orthomosaic_tiff, surface_tiff
from companion.products.run_folder import FinishedRun


@dataclass(eq=False)
class Export:
    """A run to be exported; data that several formats need is made once."""

    run: FinishedRun
    config: ExportConfig

    @cached_property
    def frame(self) -> MapFrame:
        """Coordinate frame of maps and clouds."""
        above_sea = not remarks_on_heights(self.run)
        return map_frame(self.run.origin, self.run.metric, self.config.epsg, above_sea)

    @cached_property
    def surface(self) -> Surface:
        """Height and colour rasters of the ground."""
        return surface_of(self.run.cloud, self.frame, self.config.cell_m)

    @property
    def origin(self) -> GeoOrigin:
        """Geodetic origin; InputError where unknown."""
        if self.run.origin is None:
            raise InputError(
                f"{self.run.path}: no place on Earth is known of this run, so that gpx, kml and "
                "geojson cannot be had"
            )
        return self.run.origin

    @property
    def name(self) -> str:
        """Name of the run."""
        return self.run.path.resolve().name


class Product(NamedTuple):
    """Files of a format, each with its writer, and their coordinate frame."""

    what: str
    files: Mapping[str, Callable[[Export], bytes]]
    axes: Axes = Axes.LOCAL


PRODUCTS: Mapping[str, Product] = {
    "ply": Product(
        "cloud, local NED", {"cloud.ply": lambda e: (e.run.path / "cloud.ply").read_bytes()}
    ),
    "pcd": Product("cloud", {"cloud.pcd": lambda e: cloud_pcd(e.run.cloud, e.frame)}, Axes.MAP),
    "las": Product("cloud", {"cloud.las": lambda e: _las(e, packed=False)}, Axes.MAP),
    "laz": Product("cloud, packed", {"cloud.laz": lambda e: _las(e, packed=True)}, Axes.MAP),
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


def export_run(run: FinishedRun, out: Path, config: ExportConfig) -> list[Path]:
    """Write `config.formats` into folder `out`, each file with FILE.accuracy.txt beside it.

    All files are made before any is written. InputError for an unknown format, or one that this run
    cannot give; return the files.
    """
    check_formats(config)
    export = Export(run, config)
    made: list[tuple[Path, bytes]] = []
    for name in dict.fromkeys(config.formats):
        product = PRODUCTS[name]
        axes = export.frame if product.axes is Axes.MAP else product.axes
        for file, make in product.files.items():
            path = out / file
            made.append((path, make(export)))
            statement = accuracy_statement(run, file, axes)
            made.append((path.with_name(f"{file}.accuracy.txt"), statement))
    try:
        out.mkdir(parents=True, exist_ok=True)
        for path, data in made:
            write_atomically(path, data)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from error
    return [path for path, _ in made if not path.name.endswith(".accuracy.txt")]


def check_formats(config: ExportConfig) -> None:
    """InputError where a format is unknown."""
    for name in config.formats:
        if name not in PRODUCTS:
            raise InputError(f"unknown format {name!r}; known are {', '.join(PRODUCTS)}")


def _las(export: Export, *, packed: bool) -> bytes:
    return cloud_las(export.run.cloud, export.frame, packed, f"companion {__version__}")
