"""Rows of a site map's file: features and points as arrays, all else as JSON; and back."""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.geometry.camera import Camera, Distortion
from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Array, Pose
from companion.slam.compiled.patch_alignment import STORED
from companion.slam.features.orb_features import features_of
from companion.slam.map.map_points import PointArrays
from companion.slam.map.site_map import (
    BORN_EARLIER,
    SiteGeoreference,
    SiteMap,
    SitePart,
    pixels_of,
)
from companion.slam.map.sparse_map import Keyframe

FEATURE = np.dtype([
    ("normalised", "<f4", 2), ("octaves", "u1"), ("angles_deg", "<f4"), ("descriptors", "u1", 32),
    ("point_ids", "<i4"), ("sharpness", "<f4"), ("refined", "u1"),
])  # fmt: skip
"""A feature of a keyframe; `sharpness` is its whitening relative to that of a detected corner.
Of its pixels only the direction is kept: refined, and with the rotation during a readout undone."""
POINT = np.dtype([
    ("positions", "<f8", 3), ("covariance", "<f4", 6), ("descriptors", "u1", 32),
    ("normals", "<f4", 3), ("base_distance", "<f8"), ("n_visible", "<i4"), ("n_found", "<i4"),
    ("first_seen", "<i4"), ("first_unproject", "<f4", (2, 2)), ("patch_centre", "<f4", 2),
    ("patch_level", "i1"), ("patch_grey", "u1", (STORED, STORED)),
])  # fmt: skip
UPPER = np.triu_indices(3)
QUICKLY = 1
"""Level of compression: the highest is ten times slower, for two percent less of a map."""


@dataclass(frozen=True, slots=True, eq=False)
class SiteHead:
    """Account of a map as a whole."""

    revision: int
    parts: tuple[SitePart, ...]
    georeference: SiteGeoreference
    n_keyframes: int
    n_points: int
    scale_factor: float
    n_levels: int


def head_json(site: SiteMap) -> str:
    """Account of a map as a whole."""
    found, origin = site.georeference, site.georeference.origin
    return json.dumps({
        "revision": site.revision, "n_parts": len(site.parts), "n_keyframes": len(site.keyframes),
        "n_points": len(site.points.positions), "scale_factor": site.scale_factor,
        "n_levels": site.n_levels, "origin": None if origin is None else [
            origin.latitude_deg, origin.longitude_deg, origin.altitude_m
        ],
        "sigma_m": found.sigma_m, "sigma_yaw_rad": found.sigma_yaw_rad,
        "sigma_scale": found.sigma_scale, "method": found.method,
    }, sort_keys=True)  # fmt: skip


def part_json(part: SitePart) -> str:
    """Flight and camera of a part."""
    camera, mount = part.camera, part.camera.body_from_camera
    return json.dumps({
        "flight": part.flight, "began_ns": part.began_ns, "revision": part.revision,
        "image": [camera.width, camera.height],
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "distortion": camera.distortion.value, "coefficients": list(camera.coefficients),
        "body_from_camera": None if mount is None else mount.matrix().tolist(),
        "assumed": camera.assumed, "readout_ms": camera.readout_ms,
    }, sort_keys=True)  # fmt: skip


def keyframe_json(keyframe: Keyframe) -> str:
    """Times, pose and attitude of a keyframe."""
    attitude = keyframe.ned_from_camera
    return json.dumps({
        "t_ns": keyframe.t_ns, "seq": keyframe.seq,
        "camera_from_world": keyframe.camera_from_map.matrix()[:3].tolist(),
        "ned_from_camera": None if attitude is None else attitude.tolist(),
    }, sort_keys=True)  # fmt: skip


def head_of(said: dict[str, Any], parts: tuple[SitePart, ...]) -> SiteHead:
    """The head of its JSON, and of the parts."""
    origin = None if said["origin"] is None else GeoOrigin(*map(float, said["origin"]))
    found = SiteGeoreference(
        origin, float(said["sigma_m"]), float(said["sigma_yaw_rad"]),
        float(said["sigma_scale"]), str(said["method"]),
    )  # fmt: skip
    return SiteHead(
        int(said["revision"]), parts, found, int(said["n_keyframes"]),
        int(said["n_points"]), float(said["scale_factor"]), int(said["n_levels"]),
    )  # fmt: skip


def site_part_of(said: dict[str, Any]) -> SitePart:
    """A part of its JSON."""
    mount = said["body_from_camera"]
    width, height = said["image"]
    fx, fy, cx, cy = said["intrinsics"]
    camera = Camera(
        width, height, fx, fy, cx, cy, Distortion(said["distortion"]),
        tuple(said["coefficients"]),
        None if mount is None else Pose.from_matrix(np.array(mount)), said["assumed"],
        said.get("readout_ms"),
    )  # fmt: skip
    return SitePart(said["flight"], said["began_ns"], camera, said["revision"])


def packed(rows: NDArray[np.void]) -> bytes:
    """Rows as bytes: column by column, as equal values compress where they lie together."""
    columns = (rows[name].tobytes() for name in rows.dtype.names or ())
    return zlib.compress(b"".join(columns), QUICKLY)


def unpacked(data: bytes, of: np.dtype[np.void], most: int) -> NDArray[np.void]:
    """Rows of their bytes, `most` at most; ValueError where they are none."""
    inflating = zlib.decompressobj()
    try:
        raw = inflating.decompress(data, most * of.itemsize)
    except zlib.error as error:
        raise ValueError(str(error)) from error
    if not inflating.eof or inflating.unused_data or len(raw) % of.itemsize:
        raise ValueError("the bytes are not those of whole rows")
    rows = np.zeros(len(raw) // of.itemsize, of)
    at = 0
    for name in of.names or ():
        column = rows[name]
        values = np.frombuffer(raw, column.dtype, column.size, at)
        rows[name] = values.reshape(column.shape)
        at += column.nbytes
    return rows


def feature_rows(keyframe: Keyframe) -> NDArray[np.void]:
    """Features of a keyframe."""
    features = keyframe.features
    rows = np.zeros(len(features), FEATURE)
    for name in ("octaves", "angles_deg", "descriptors"):
        rows[name] = getattr(features, name)
    rows["point_ids"], rows["normalised"] = keyframe.point_ids, keyframe.normalised
    # refinement changes the size of a whitening only
    rows["sharpness"] = keyframe.whitening[:, 0, 0] / features.whitening[:, 0, 0]
    rows["refined"] = keyframe.refined_for >= 0
    return rows


def keyframe_of(
    key: int, said: dict[str, Any], rows: NDArray[np.void], camera: Camera, scale_factor: float
) -> Keyframe:
    """A keyframe of its JSON and the rows of its features."""
    point_ids = rows["point_ids"].astype(np.int64)
    normalised: Array = rows["normalised"].astype(np.float64)
    features = features_of(
        camera, scale_factor, pixels_of(camera, normalised), normalised.copy(),
        rows["octaves"].astype(np.int64), rows["angles_deg"].copy(), rows["descriptors"].copy(),
    )  # fmt: skip
    refined = rows["refined"] > 0
    whitening = features.whitening * rows["sharpness"][:, None, None].astype(np.float64)
    attitude = said["ned_from_camera"]
    return Keyframe(
        key, said["seq"], said["t_ns"],
        Pose.from_matrix(np.vstack([said["camera_from_world"], [0.0, 0.0, 0.0, 1.0]])), features,
        point_ids, normalised, whitening, np.where(refined, point_ids, -1),
        ned_from_camera=None if attitude is None else np.array(attitude),
    )  # fmt: skip


def point_rows(site: SiteMap, own: slice) -> NDArray[np.void]:
    """Some points of a map."""
    rows = np.zeros(len(site.points.positions[own]), POINT)
    for name in PointArrays._fields:
        if name != "born":
            rows[name] = getattr(site.points, name)[own]
    rows["covariance"] = site.covariances[own, UPPER[0], UPPER[1]]
    return rows


def point_arrays(rows: NDArray[np.void]) -> PointArrays:
    """Points of their rows."""
    wider: dict[str, Any] = {"i": np.int64, "f": np.float64, "u": np.uint8}
    values = {
        name: rows[name].astype(wider[rows[name].dtype.kind])
        for name in PointArrays._fields
        if name != "born"
    }
    return PointArrays(**values, born=np.full(len(rows), BORN_EARLIER, np.int64))


def covariances_of(rows: NDArray[np.void]) -> Array:
    """Covariances (P, 3, 3) of the points of rows."""
    covariance = np.zeros((len(rows), 3, 3))
    covariance[:, UPPER[0], UPPER[1]] = covariance[:, UPPER[1], UPPER[0]] = rows["covariance"]
    return covariance
