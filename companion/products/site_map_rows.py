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
from companion.slam.loop.place_recognition import PLACES_VERSION
from companion.slam.map.map_points import PointArrays
from companion.slam.map.patch_store import PatchRows
from companion.slam.map.seen import Seen, SeenLater
from companion.slam.map.site_map import (
    BORN_EARLIER,
    SiteGeoreference,
    SiteMap,
    SitePart,
    pixels_of,
)
from companion.slam.map.sparse_map import Keyframe

OBSERVED = np.dtype([("feature", "<u2"), ("point", "<i4"), ("refined", "u1")])
"""A feature of a keyframe that observes a point."""
FEATURE = np.dtype([
    ("normalised", "<f4", 2), ("octaves", "u1"), ("angles_deg", "<f4"), ("descriptors", "u1", 32),
    ("sharpness", "<f4"),
])  # fmt: skip
"""A feature of a keyframe; `sharpness` is its whitening relative to that of a detected corner.
Of its pixels only the direction is kept: refined, and with the rotation during a readout undone."""
WHOLE_FEATURE = np.dtype([
    *FEATURE.descr[:-1], ("point_ids", "<i4"), FEATURE.descr[-1], ("refined", "u1"),
])  # fmt: skip
"""A feature, the point that it observes and whether it is refined, as before version 3."""
POINT = np.dtype([
    ("positions", "<f8", 3), ("covariance", "<f4", 6), ("descriptors", "u1", 32),
    ("normals", "<f4", 3), ("base_distance", "<f8"), ("n_visible", "<i4"), ("n_found", "<i4"),
    ("first_seen", "<i4"), ("first_unproject", "<f4", (2, 2)), ("patch_centre", "<f4", 2),
    ("patch_level", "i1"),
])  # fmt: skip
PATCH = np.dtype([("patch_grey", "u1", (STORED, STORED))])
WHOLE_POINT = np.dtype([*POINT.descr, *PATCH.descr])
"""A point and its patch, as before version 3."""
KEPT = [name for name in PointArrays._fields if name not in ("born", "patch_grey")]
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
    n_places: int
    """Blocks of the index of places, 0 without one that is of use."""
    scale_factor: float
    n_levels: int


def head_json(site: SiteMap, n_places: int) -> str:
    """Account of a map as a whole, of which so many blocks index the places."""
    found, origin = site.georeference, site.georeference.origin
    return json.dumps({
        "revision": site.revision, "n_parts": len(site.parts), "n_keyframes": len(site.keyframes),
        "n_points": len(site.points.positions), "scale_factor": site.scale_factor,
        "n_levels": site.n_levels, "n_places": n_places, "places_version": PLACES_VERSION,
        "origin": None if origin is None else [
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
        "t_ns": keyframe.t_ns, "seq": keyframe.seq, "n_features": len(keyframe.point_ids),
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
        int(said["n_points"]),
        int(said["n_places"]) if said.get("places_version") == PLACES_VERSION else 0,
        float(said["scale_factor"]), int(said["n_levels"]),
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


def unpacked(data: bytes | memoryview, of: np.dtype[np.void], most: int) -> NDArray[np.void]:
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


def observed_rows(keyframe: Keyframe) -> NDArray[np.void]:
    """Points that the features of a keyframe observe."""
    return _observed(keyframe.point_ids, keyframe.refined_for >= 0)


def observed_before(rows: NDArray[np.void]) -> NDArray[np.void]:
    """The same of whole features."""
    return _observed(rows["point_ids"], rows["refined"])


def _observed(point_ids: NDArray[Any], refined: NDArray[Any]) -> NDArray[np.void]:
    features = np.flatnonzero(point_ids >= 0)
    rows = np.zeros(len(features), OBSERVED)
    rows["feature"], rows["point"] = features, point_ids[features]
    rows["refined"] = refined[features]
    return rows


def feature_rows(keyframe: Keyframe) -> NDArray[np.void]:
    """Features of a keyframe."""
    features = keyframe.features
    rows = np.zeros(len(features), FEATURE)
    for name in ("octaves", "angles_deg", "descriptors"):
        rows[name] = getattr(features, name)
    rows["normalised"] = keyframe.normalised
    # refinement changes the size of a whitening only
    rows["sharpness"] = keyframe.whitening[:, 0, 0] / features.whitening[:, 0, 0]
    return rows


def keyframe_of(
    key: int, said: dict[str, Any], observed: NDArray[np.void], seen: Seen | SeenLater
) -> Keyframe:
    """A keyframe of its JSON, the rows of what it observes, and what it saw."""
    attitude = said["ned_from_camera"]
    point_ids, refined_for = np.full((2, said["n_features"]), -1)
    point_ids[observed["feature"]] = observed["point"]
    refined_for[observed["feature"]] = np.where(observed["refined"], observed["point"], -1)
    return Keyframe(
        key, said["seq"], said["t_ns"],
        Pose.from_matrix(np.array(said["camera_from_world"])), seen,
        point_ids, refined_for,
        ned_from_camera=None if attitude is None else np.array(attitude),
        is_far=isinstance(seen, SeenLater),
    )  # fmt: skip


def seen_of(rows: NDArray[np.void], camera: Camera, scale_factor: float) -> Seen:
    """View of a keyframe, of the rows of its features."""
    normalised: Array = rows["normalised"].astype(np.float64)
    features = features_of(
        camera, scale_factor, pixels_of(camera, normalised), normalised.copy(),
        rows["octaves"].astype(np.int64), rows["angles_deg"].copy(), rows["descriptors"].copy(),
    )  # fmt: skip
    whitening = features.whitening * rows["sharpness"][:, None, None].astype(np.float64)
    return Seen(features, normalised, whitening)


def point_rows(site: SiteMap, own: slice) -> NDArray[np.void]:
    """Some points of a map, without their patches."""
    rows = np.zeros(len(site.points.positions[own]), POINT)
    for name in KEPT:
        rows[name] = getattr(site.points, name)[own]
    rows["covariance"] = site.covariances[own, UPPER[0], UPPER[1]]
    return rows


def patch_rows(site: SiteMap, own: slice) -> NDArray[np.void]:
    """Patches of some points of a map."""
    rows = np.zeros(len(site.points.positions[own]), PATCH)
    rows["patch_grey"] = site.points.patch_grey[own]
    return rows


def point_arrays(rows: NDArray[np.void], patch_grey: PatchRows) -> PointArrays:
    """Points of their rows and patches."""
    wider: dict[str, Any] = {"i": np.int64, "f": np.float64, "u": np.uint8}
    values = {name: rows[name].astype(wider[rows[name].dtype.kind]) for name in KEPT}
    born = np.full(len(rows), BORN_EARLIER, np.int64)
    return PointArrays(**values, born=born, patch_grey=patch_grey)


def covariances_of(rows: NDArray[np.void]) -> Array:
    """Covariances (P, 3, 3) of the points of rows."""
    covariance = np.zeros((len(rows), 3, 3))
    covariance[:, UPPER[0], UPPER[1]] = covariance[:, UPPER[1], UPPER[0]] = rows["covariance"]
    return covariance
