"""Point cloud as LAS 1.4, uncompressed or LAZ."""

from __future__ import annotations

import io

import laspy
import numpy as np
from laspy.vlrs.known import WktCoordinateSystemVlr

from companion.products.cloud import Cloud
from companion.products.export.map_frame import MapFrame

STEP_M = 0.001
POINT_FORMAT = 7
"""Position, colour and a time that stays zero: points are of no single moment."""
EXTRA = (
    ("confidence", "0..1"), ("sigma", "standard deviation"),
    ("normal_x", "towards the camera"), ("normal_y", ""), ("normal_z", ""),
)  # fmt: skip


def cloud_las(cloud: Cloud, frame: MapFrame, packed: bool, software: str) -> bytes:
    """Points to the millimetre, colours of 16 bits, and extra numbers for each point.

    These are `confidence` (0..1), `sigma` (one standard deviation, metres; nan where not known) and
    the unit normal `normal_x` `normal_y` `normal_z` (zero where not known).
    """
    header = laspy.LasHeader(version="1.4", point_format=POINT_FORMAT)
    header.generating_software = software[:32]
    header.creation_date = None
    for name, what in EXTRA:
        header.add_extra_dim(laspy.ExtraBytesParams(name, np.float32, what))
    coordinates = frame.coordinates(cloud.points.astype(np.float64))
    if len(coordinates):
        header.offsets = np.floor(coordinates.min(0))
    header.scales = np.full(3, STEP_M)
    if frame.wkt:
        header.vlrs.append(WktCoordinateSystemVlr(frame.wkt_with_height))
    header.global_encoding.wkt = True
    las = laspy.LasData(header)
    las.x, las.y, las.z = coordinates.T
    # eight bits spread over sixteen, as the format has it
    las.red, las.green, las.blue = cloud.rgb.astype(np.uint16).T * 257
    las.confidence, las.sigma = cloud.confidence, cloud.sigma
    las.normal_x, las.normal_y, las.normal_z = frame.directions(cloud.normals, cloud.points).T
    las.return_number = np.ones(len(cloud), np.uint8)
    las.number_of_returns = np.ones(len(cloud), np.uint8)
    out = io.BytesIO()
    las.write(out, do_compress=packed, laz_backend=laspy.LazBackend.Lazrs if packed else None)
    return out.getvalue()
