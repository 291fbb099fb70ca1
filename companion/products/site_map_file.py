"""File of a site map: SQLite, with a digest for each keyframe and each block of points.

It is written beside its place, synchronised, and moved there in one step, so that a loss of power
leaves the old file or the new one. A damaged file is read as far as its keyframes and blocks are
whole; without head and calibrations it is refused.
"""

from __future__ import annotations

import hashlib
import json
import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from companion.errors import InputError
from companion.geometry.camera import Camera, Distortion
from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Array, Pose
from companion.products.atomic_file import sync
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

SITE_MAP = "site.map"
"""Its name in the folder of a run."""
APPLICATION_ID = 0x534D4150
"""SQLite's application_id: SMAP."""
VERSION = 1
"""SQLite's user_version; a newer one is refused."""
BLOCK = 1024
"""Points in a row."""
DIGEST_BYTES = 16
MAX_POINTS, MAX_FEATURES, MAX_KEYFRAMES = 5_000_000, 20_000, 100_000
"""More are no map of ours."""

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
SCHEMA = f"""
PRAGMA application_id = {APPLICATION_ID};
PRAGMA user_version = {VERSION};
CREATE TABLE head (id INTEGER PRIMARY KEY, json TEXT NOT NULL, digest BLOB NOT NULL);
CREATE TABLE part (id INTEGER PRIMARY KEY, json TEXT NOT NULL, digest BLOB NOT NULL);
CREATE TABLE keyframe (
  id INTEGER PRIMARY KEY, part INTEGER NOT NULL, json TEXT NOT NULL, features BLOB NOT NULL,
  digest BLOB NOT NULL);
CREATE TABLE points (id INTEGER PRIMARY KEY, data BLOB NOT NULL, digest BLOB NOT NULL);
"""
"""Of `points`, id is the first point of a block."""


class SiteMapError(InputError):
    """A site map cannot be read; the reason in words."""


@dataclass(frozen=True, slots=True, eq=False)
class ReadSiteMap:
    """A site map as read, and what of it was damaged."""

    site: SiteMap
    damaged: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SiteHead:
    """Head of a file: its account of the map as a whole."""

    revision: int
    parts: tuple[SitePart, ...]
    georeference: SiteGeoreference
    n_keyframes: int
    n_points: int
    scale_factor: float
    n_levels: int


def map_path(given: str | Path) -> Path:
    """The site map that a file, or the folder of a run, stands for."""
    path = Path(given).expanduser()
    return path / SITE_MAP if path.is_dir() else path


def write_site_map(path: Path, site: SiteMap) -> None:
    """Write a site map, durably and in one step; OSError where it cannot be."""
    part = path.with_name(f".{path.name}.part")
    part.unlink(missing_ok=True)
    try:
        with closing(sqlite3.connect(part, isolation_level=None)) as file:
            # a crash leaves the part, which is never read
            file.execute("PRAGMA journal_mode = OFF")
            file.execute("PRAGMA synchronous = OFF")
            file.executescript(SCHEMA)
            file.execute("BEGIN")
            file.execute("INSERT INTO head VALUES (0, ?, ?)", _signed(_head_json(site)))
            for n, each in enumerate(site.parts):
                file.execute("INSERT INTO part VALUES (?, ?, ?)", (n, *_signed(_part_json(each))))
            for key, which in zip(site.keyframes, site.part_of.tolist(), strict=True):
                text, data = _keyframe_json(key), _feature_rows(key).tobytes()
                row = (key.keyframe_id, which, text, data, _digest(which, text, data))
                file.execute("INSERT INTO keyframe VALUES (?, ?, ?, ?, ?)", row)
            for first, data in _blocks(site):
                block = (first, data, _digest(first, data))
                file.execute("INSERT INTO points VALUES (?, ?, ?)", block)
            file.execute("COMMIT")
        sync(part)
        os.replace(part, path)
        sync(path.parent)
    except sqlite3.Error as error:
        raise OSError(0, f"{error}", str(path)) from error
    finally:
        part.unlink(missing_ok=True)


def digest_of(path: Path) -> str:
    """BLAKE2b digest of a file, by which a flight's recording knows the map that it used."""
    digest = hashlib.blake2b(digest_size=DIGEST_BYTES)
    with path.open("rb") as file:
        while data := file.read(1 << 20):
            digest.update(data)
    return digest.hexdigest()


def read_head(path: Path) -> SiteHead:
    """The head of a file; SiteMapError where it cannot be read."""
    with closing(_opened(path)) as file:
        return _head_of(path, file)


def read_site_map(path: Path) -> ReadSiteMap:
    """Read a site map as far as it is whole; SiteMapError where nothing of it can be used."""
    with closing(_opened(path)) as file:
        head = _head_of(path, file)
        damaged: list[str] = []
        rows = _points(file, head, damaged)
        n_keyframes = head.n_keyframes
        keyframes, part_of = [], []
        for n in range(n_keyframes):
            found = _keyframe(file, n, head, len(rows))
            if found is None:
                damaged.append(f"keyframe {n}")
            else:
                keyframes.append(found[0])
                part_of.append(found[1])
    if not keyframes:
        raise SiteMapError(f"{path}: it is damaged: none of its {n_keyframes} keyframes is whole")
    lost = np.isnan(rows["positions"][:, 0])
    for keyframe in keyframes:  # what observes a point of a lost block observes none
        ids = keyframe.point_ids
        ids[(ids >= 0) & lost[ids]] = -1
    covariance = np.zeros((len(rows), 3, 3))
    covariance[:, UPPER[0], UPPER[1]] = covariance[:, UPPER[1], UPPER[0]] = rows["covariance"]
    site = SiteMap(
        head.revision, head.parts, tuple(keyframes), np.array(part_of, np.int64),
        _point_arrays(rows), covariance, head.georeference, head.scale_factor, head.n_levels,
    )  # fmt: skip
    return ReadSiteMap(site, tuple(damaged))


# -- writing -------------------------------------------------------------------------------------


def _digest(*parts: int | str | bytes) -> bytes:
    digest = hashlib.blake2b(digest_size=DIGEST_BYTES)
    for part in parts:
        digest.update(part if isinstance(part, bytes) else str(part).encode())
        digest.update(b"\0")
    return digest.digest()


def _signed(text: str) -> tuple[str, bytes]:
    return text, _digest(text)


def _head_json(site: SiteMap) -> str:
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


def _part_json(part: SitePart) -> str:
    camera, mount = part.camera, part.camera.body_from_camera
    return json.dumps({
        "flight": part.flight, "began_ns": part.began_ns, "revision": part.revision,
        "image": [camera.width, camera.height],
        "intrinsics": [camera.fx, camera.fy, camera.cx, camera.cy],
        "distortion": camera.distortion.value, "coefficients": list(camera.coefficients),
        "body_from_camera": None if mount is None else mount.matrix().tolist(),
        "assumed": camera.assumed, "readout_ms": camera.readout_ms,
    }, sort_keys=True)  # fmt: skip


def _keyframe_json(keyframe: Keyframe) -> str:
    attitude = keyframe.ned_from_camera
    return json.dumps({
        "t_ns": keyframe.t_ns, "seq": keyframe.seq,
        "camera_from_world": keyframe.camera_from_map.matrix()[:3].tolist(),
        "ned_from_camera": None if attitude is None else attitude.tolist(),
    }, sort_keys=True)  # fmt: skip


def _feature_rows(keyframe: Keyframe) -> NDArray[np.void]:
    features = keyframe.features
    rows = np.zeros(len(features), FEATURE)
    for name in ("octaves", "angles_deg", "descriptors"):
        rows[name] = getattr(features, name)
    rows["point_ids"], rows["normalised"] = keyframe.point_ids, keyframe.normalised
    # refinement changes the size of a whitening only
    rows["sharpness"] = keyframe.whitening[:, 0, 0] / features.whitening[:, 0, 0]
    rows["refined"] = keyframe.refined_for >= 0
    return rows


def _blocks(site: SiteMap) -> Iterator[tuple[int, bytes]]:
    for first in range(0, len(site.points.positions), BLOCK):
        own = slice(first, first + BLOCK)
        rows = np.zeros(len(site.points.positions[own]), POINT)
        for name in PointArrays._fields:
            if name != "born":
                rows[name] = getattr(site.points, name)[own]
        rows["covariance"] = site.covariances[own, UPPER[0], UPPER[1]]
        yield first, rows.tobytes()


# -- reading -------------------------------------------------------------------------------------


def _opened(path: Path) -> sqlite3.Connection:
    if not path.is_file():
        raise SiteMapError(f"{path}: there is no such file; wanted is the {SITE_MAP} of a run")
    try:
        # of a file that nobody changes: it is replaced as a whole
        file = sqlite3.connect(f"file:{quote(str(path.resolve()))}?immutable=1", uri=True)
        (application,) = file.execute("PRAGMA application_id").fetchone()
        (version,) = file.execute("PRAGMA user_version").fetchone()
    except sqlite3.Error as error:
        raise SiteMapError(f"{path}: it is no site map, or damaged: {error}") from error
    if application != APPLICATION_ID:
        file.close()
        raise SiteMapError(f"{path}: it is no site map")
    if version > VERSION:
        file.close()
        raise SiteMapError(
            f"{path}: it is of version {version}, and this program reads up to {VERSION}: "
            "use the companion that wrote it, or a newer one"
        )
    return file


def _head_of(path: Path, file: sqlite3.Connection) -> SiteHead:
    try:
        head = json.loads(_checked(file.execute("SELECT json, digest FROM head").fetchone()))
        parts = []
        for n in range(int(head["n_parts"])):
            row = file.execute("SELECT json, digest FROM part WHERE id = ?", (n,)).fetchone()
            parts.append(_part(json.loads(_checked(row))))
        origin = None if head["origin"] is None else GeoOrigin(*map(float, head["origin"]))
        found = SiteGeoreference(
            origin, float(head["sigma_m"]), float(head["sigma_yaw_rad"]),
            float(head["sigma_scale"]), str(head["method"]),
        )  # fmt: skip
        out = SiteHead(
            int(head["revision"]), tuple(parts), found, int(head["n_keyframes"]),
            int(head["n_points"]), float(head["scale_factor"]), int(head["n_levels"]),
        )  # fmt: skip
    except (sqlite3.Error, ValueError, KeyError, TypeError, IndexError) as error:
        raise SiteMapError(f"{path}: its head is damaged ({error})") from error
    within = 0 < out.n_keyframes <= MAX_KEYFRAMES and 0 <= out.n_points <= MAX_POINTS
    if not (within and out.parts and 1.0 < out.scale_factor <= 2.0 and 1 <= out.n_levels <= 16):
        raise SiteMapError(f"{path}: its head is not that of a site map")
    return out


def _checked(row: Any) -> str:
    if row is None or _digest(row[0]) != row[1]:
        raise ValueError("a row is missing, or its digest is not its own")
    return str(row[0])


def _part(said: dict[str, Any]) -> SitePart:
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


def _row(file: sqlite3.Connection, query: str, key: int) -> Any:
    try:
        return file.execute(query, (key,)).fetchone()
    except sqlite3.Error:  # a damaged page
        return None


def _points(file: sqlite3.Connection, head: SiteHead, damaged: list[str]) -> NDArray[np.void]:
    rows = np.zeros(head.n_points, POINT)
    for first in range(0, head.n_points, BLOCK):
        row = _row(file, "SELECT data, digest FROM points WHERE id = ?", first)
        own = rows[first : first + BLOCK]
        if row is None or len(row[0]) != own.nbytes or _digest(first, row[0]) != row[1]:
            damaged.append(f"points {first} to {first + len(own) - 1}")
            own["positions"] = np.nan
        else:
            own[:] = np.frombuffer(row[0], POINT)
    return rows


def _point_arrays(rows: NDArray[np.void]) -> PointArrays:
    wider: dict[str, Any] = {"i": np.int64, "f": np.float64, "u": np.uint8}
    values = {
        name: rows[name].astype(wider[rows[name].dtype.kind])
        for name in PointArrays._fields
        if name != "born"
    }
    return PointArrays(**values, born=np.full(len(rows), BORN_EARLIER, np.int64))


def _keyframe(
    file: sqlite3.Connection, key: int, head: SiteHead, n_points: int
) -> tuple[Keyframe, int] | None:
    """A keyframe and its part; None where it is damaged."""
    query = "SELECT part, json, features, digest FROM keyframe WHERE id = ?"
    row = _row(file, query, key)
    if row is None or _digest(*row[:3]) != row[3] or len(row[2]) % FEATURE.itemsize:
        return None
    part, said = row[0], json.loads(row[1])
    rows = np.frombuffer(row[2], FEATURE)
    if not 0 <= part < len(head.parts) or not 0 < len(rows) <= MAX_FEATURES:
        return None
    camera = head.parts[part].camera
    point_ids = rows["point_ids"].astype(np.int64)
    if point_ids.max() >= n_points:
        return None
    normalised: Array = rows["normalised"].astype(np.float64)
    features = features_of(
        camera, head.scale_factor, pixels_of(camera, normalised), normalised.copy(),
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
    ), part  # fmt: skip
