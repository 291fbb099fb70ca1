"""Surface model as GeoTIFF: heights, and an orthomosaic of the cloud's colours."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.errors import InputError
from companion.products.export.image_mosaic import Mosaic
from companion.products.export.map_frame import MapFrame
from companion.products.export.surface import Surface

NODATA = -9999.0
TILED = {"compress": "deflate", "tiled": True, "blockxsize": 256, "blockysize": 256}


def surface_tiff(surface: Surface, frame: MapFrame) -> bytes:
    """Heights in metres as 32-bit floats; nodata -9999."""
    heights = np.where(np.isfinite(surface.height), surface.height, NODATA)[None]
    return _tiff(heights.astype(np.float32), surface, frame, nodata=NODATA, predictor=3)


def orthomosaic_tiff(surface: Surface, frame: MapFrame) -> bytes:
    """Red, green, blue and alpha; transparent where not seen.

    Made of the cloud's colours, and so no finer than the cloud.
    """
    alpha = np.where(np.isfinite(surface.height), 255, 0).astype(np.uint8)
    bands = np.concatenate([np.moveaxis(surface.rgb, 2, 0), alpha[None]])
    return _tiff(bands, surface, frame, photometric="RGB", alpha="YES", predictor=2)


def mosaic_tiff(mosaic: Mosaic, frame: MapFrame) -> bytes:
    """Red, green, blue and alpha of the pictures; transparent where none showed the place."""
    alpha = np.where(mosaic.seen, 255, 0).astype(np.uint8)
    bands = np.concatenate([np.moveaxis(mosaic.rgb, 2, 0), alpha[None]])
    return _tiff(bands, mosaic, frame, photometric="RGB", alpha="YES", predictor=2)


def _tiff(
    bands: NDArray[Any], surface: Surface | Mosaic, frame: MapFrame, **options: object
) -> bytes:
    try:
        from rasterio import Affine
        from rasterio.io import MemoryFile
    except ImportError as error:
        raise InputError("GeoTIFF needs rasterio: pip install '.[survey]' in a clone") from error
    count, height, width = bands.shape
    transform = Affine(surface.cell_m, 0, surface.west, 0, -surface.cell_m, surface.north)
    with MemoryFile() as memory:
        with memory.open(
            driver="GTiff", width=width, height=height, count=count, dtype=bands.dtype,
            crs=frame.wkt or None, transform=transform, **TILED, **options,
        ) as raster:  # fmt: skip
            raster.write(bands)
            raster.update_tags(AREA_OR_POINT="Area", COORDINATES=frame.name)
        return bytes(memory.read())
