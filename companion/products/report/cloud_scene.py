"""Cloud, path and keyframes for the page's 3-D view: quantised, and sorted by level of detail."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from importlib import resources
from typing import NamedTuple

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from companion.geometry.geodesy import GeoOrigin, earth_from_ned
from companion.geometry.transforms import Array, Pose
from companion.products.cloud import Cloud

MAX_POINTS = 750_000
"""Points in a page, 12 bytes each as text: 9 MB, beside pictures and plots of 1 to 3 MB."""
MAX_PATH_POINTS = 4000
STEPS = 65535
"""Steps of a coordinate over the longest side of the cloud: 5 mm of 300 m."""
N_SPACING = 2000
SCRIPTS = ("orbit_camera.js", "cloud_drawing.js", "cloud_picking.js", "cloud_view.js")


class PlacedKeyframe(NamedTuple):
    """Keyframe of the final map: `t_s` seconds since the first frame, None where not known."""

    keyframe_id: int
    t_s: float | None
    world_from_camera: Pose


class CloudScene(NamedTuple):
    """Parts of the page: numbers and points as text, and the program that draws them."""

    facts: Markup
    """JSON; see `cloud_scene`."""
    points: str
    """Base64 of all positions (N, 3) u16, then all colours (N, 3) u8."""
    program: Markup
    n_points: int


def cloud_scene(
    cloud: Cloud,
    segments: Sequence[Array],
    keyframes: Sequence[PlacedKeyframe],
    view: tuple[float, float],
    unit: str,
    origin: GeoOrigin | None,
) -> CloudScene | None:
    """The scene of a cloud; None for an empty one.

    `segments` are unbroken parts (N, 3) of the camera's path in the world, `view` the heading and
    the pitch downwards, radians, from which it is seen first, `origin` that of the world where it
    is on Earth. Of a cloud larger than `MAX_POINTS` as many are taken, evenly.
    """
    if len(cloud) == 0:
        return None
    order = coarse_to_fine(cloud.points)[:MAX_POINTS]
    points = cloud.points[order].astype(np.float64)
    low = points.min(0)
    step = max(float(np.ptp(points, axis=0).max()), 1e-6) / STEPS
    quantised = np.rint((points - low) / step).astype("<u2")
    data = quantised.tobytes() + np.ascontiguousarray(cloud.rgb[order]).tobytes()
    facts = {
        "low": low.tolist(),
        "step": step,
        "n": len(order),
        "spacing": _spacing(points),
        "around": _around(points, segments).tolist(),
        "unit": unit,
        "view": list(view),
        "paths": [_rounded(_sparse(path)) for path in segments],
        "keyframes": [
            {
                "id": keyframe_id,
                "t_s": None if t_s is None else round(t_s, 2),
                "at": _rounded(pose.translation),
                "axes": [round(float(v), 4) for v in pose.rotation.T.ravel()],
            }
            for keyframe_id, t_s, pose in keyframes
        ],
        "earth": None if origin is None else _earth(origin),
    }
    text = json.dumps(facts, separators=(",", ":"), allow_nan=False)
    return CloudScene(
        Markup(text.replace("<", "\\u003c")),
        base64.b64encode(data).decode("ascii"),
        Markup(_program()),
        len(order),
    )


def _around(points: Array, segments: Sequence[Array]) -> Array:
    """Corners (2, 3) of the box seen first: most of the cloud, and all of the path seen from above.

    Its heights are the cloud's: a path high above it would push it out of the middle.
    """
    around = np.percentile(points, [2, 98], axis=0)
    if segments:
        path = np.concatenate(segments)[:, :2]
        around[0, :2] = np.minimum(around[0, :2], path.min(0))
        around[1, :2] = np.maximum(around[1, :2], path.max(0))
    return around


def coarse_to_fine(points: NDArray[np.floating]) -> NDArray[np.int64]:
    """Order in which each beginning of the points (N, 3) is spread evenly over all of them.

    Along a Z-order curve (Morton 1966), visited in the order of van der Corput's sequence: the
    first half is every second point of the curve, the first quarter every fourth.
    """
    if len(points) == 0:
        return np.zeros(0, np.int64)
    low = points.min(0)
    side = max(float(np.ptp(points, axis=0).max()), 1e-9)
    cells = np.minimum((points - low) * (2**21 / side), 2**21 - 1).astype(np.uint64)
    code = _spread(cells[:, 0]) << np.uint64(2)
    code |= _spread(cells[:, 1]) << np.uint64(1) | _spread(cells[:, 2])
    along = np.argsort(code, kind="stable")
    bits = max(int(len(points) - 1).bit_length(), 1)
    turns = np.arange(2**bits, dtype=np.uint32)
    reversed_bits = np.zeros_like(turns)
    for bit in range(bits):
        reversed_bits |= (turns >> np.uint32(bit) & np.uint32(1)) << np.uint32(bits - 1 - bit)
    visited: NDArray[np.int64] = along[reversed_bits[reversed_bits < len(points)]]
    return visited


def _spread(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Numbers of 21 bits with two zero bits between each and the next."""
    out = values
    for shift, mask in (
        (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249),
    ):  # fmt: skip
        out = (out | out << np.uint64(shift)) & np.uint64(mask)
    return out


def _spacing(points: Array) -> float:
    """Median distance of a point to its nearest neighbour."""
    if len(points) < 2:
        return 1.0
    # for so few queries, a tree that is quick to build
    tree = cKDTree(points, compact_nodes=False, balanced_tree=False)
    distance, _ = tree.query(points[:N_SPACING], k=2)
    return max(float(np.median(distance[:, 1])), 1e-6)


def _earth(origin: GeoOrigin) -> dict[str, list[float]]:
    """Earth-centred coordinates of local NED: its zero, and its axes as rows north, east, down."""
    zero, axes = earth_from_ned(origin)
    return {"zero": zero.tolist(), "axes": axes.ravel().tolist()}


def _sparse(path: Array) -> Array:
    chosen = np.unique(np.linspace(0, len(path) - 1, MAX_PATH_POINTS).round().astype(int))
    kept: Array = path[chosen]
    return kept


def _rounded(values: Array) -> list[float]:
    """To the millimetre, one after the other."""
    return [round(float(v), 3) for v in values.ravel()]


def _program() -> str:
    folder = resources.files("companion.products.report") / "scene"
    return "\n".join((folder / name).read_text("utf-8") for name in SCRIPTS)
