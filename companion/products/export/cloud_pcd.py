"""Point cloud as a binary PCD file of the Point Cloud Library."""

from __future__ import annotations

import numpy as np

from companion.products.cloud import Cloud
from companion.products.export.map_frame import MapFrame

POINT = np.dtype(
    [
        ("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4"),
        ("normal_x", "<f4"), ("normal_y", "<f4"), ("normal_z", "<f4"),
        ("confidence", "<f4"), ("sigma", "<f4"),
    ]
)  # fmt: skip


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
    facing = frame.directions(cloud.normals, cloud.points)
    for axis, name in enumerate(("normal_x", "normal_y", "normal_z")):
        points[name] = facing[:, axis]
    points["confidence"], points["sigma"] = cloud.confidence, cloud.sigma
    names = POINT.names or ()
    head = [
        "# .PCD v0.7 - Point Cloud Data file format",
        f"# {frame.name}" + (f", EPSG:{frame.epsg}" if frame.epsg else ""),
        "# add to x y z: " + " ".join(f"{v:.0f}" for v in shift),
        "VERSION 0.7", " ".join(["FIELDS", *names]), "SIZE" + " 4" * len(names),
        " ".join(["TYPE", *(POINT[name].kind.upper() for name in names)]),
        "COUNT" + " 1" * len(names), f"WIDTH {len(cloud)}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(cloud)}", "DATA binary",
    ]  # fmt: skip
    return ("\n".join(head) + "\n").encode("ascii") + points.tobytes()
