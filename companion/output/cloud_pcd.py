"""The cloud as a binary PCD file of the Point Cloud Library."""

from __future__ import annotations

import numpy as np

from companion.output.flight_result import Cloud
from companion.output.map_frame import MapFrame

POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4"), ("confidence", "<f4")])


def cloud_pcd(cloud: Cloud, frame: MapFrame) -> bytes:
    """Points east, north and up; of large coordinates only what is beyond a shift in the head.

    The format's numbers have seven digits, which for map coordinates would be decimetres.
    """
    coordinates = frame.coordinates(cloud.points.astype(np.float64))
    shift = np.floor(coordinates.mean(0)) if frame.wkt and len(cloud) else np.zeros(3)
    points = np.zeros(len(cloud), POINT)
    for axis, name in enumerate("xyz"):
        points[name] = coordinates[:, axis] - shift[axis]
    red, green, blue = cloud.rgb.astype(np.uint32).T
    points["rgb"] = red << 16 | green << 8 | blue
    points["confidence"] = cloud.confidence
    head = [
        "# .PCD v0.7 - Point Cloud Data file format",
        f"# {frame.name}" + (f", EPSG:{frame.epsg}" if frame.epsg else ""),
        "# add to x y z: " + " ".join(f"{v:.0f}" for v in shift),
        "VERSION 0.7", "FIELDS x y z rgb confidence", "SIZE 4 4 4 4 4", "TYPE F F F U F",
        "COUNT 1 1 1 1 1", f"WIDTH {len(cloud)}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(cloud)}", "DATA binary",
    ]  # fmt: skip
    return ("\n".join(head) + "\n").encode("ascii") + points.tobytes()
