"""The cloud as LAS 1.4, plain or packed (LAZ)."""

from __future__ import annotations

import io

import laspy
import numpy as np
from laspy.vlrs.known import WktCoordinateSystemVlr

from companion.output.flight_result import Cloud
from companion.output.map_frame import MapFrame

STEP_M = 0.001
POINT_FORMAT = 7
"""Position, colour and a time that stays zero: points are of no single moment."""


def cloud_las(cloud: Cloud, frame: MapFrame, packed: bool, software: str) -> bytes:
    """Points to the millimetre, colours of 16 bits, and `confidence` (0..1) as an extra number."""
    header = laspy.LasHeader(version="1.4", point_format=POINT_FORMAT)
    header.generating_software = software[:32]
    header.creation_date = None
    header.add_extra_dim(laspy.ExtraBytesParams("confidence", np.float32, "0..1"))
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
    las.confidence = cloud.confidence
    las.return_number = np.ones(len(cloud), np.uint8)
    las.number_of_returns = np.ones(len(cloud), np.uint8)
    out = io.BytesIO()
    las.write(out, do_compress=packed, laz_backend=laspy.LazBackend.Lazrs if packed else None)
    return out.getvalue()
