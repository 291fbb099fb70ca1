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
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from companion.errors import InputError
from companion.products.array_file import ArrayFile
from companion.products.atomic_file import sync
from companion.products.site_map_rows import (
    FEATURE,
    POINT,
    SiteHead,
    covariances_of,
    feature_rows,
    head_json,
    head_of,
    keyframe_json,
    keyframe_of,
    packed,
    part_json,
    point_arrays,
    point_rows,
    site_part_of,
    unpacked,
)
from companion.slam.map.site_map import SiteMap
from companion.slam.map.sparse_map import Keyframe
from companion.slam.mapping.far_keyframes import put_away

SITE_MAP = "site.map"
"""Its name in the folder of a run."""
APPLICATION_ID = 0x534D4150
"""SQLite's application_id: SMAP."""
VERSION = 2
"""SQLite's user_version; a newer one is refused. Rows of version 1 are not packed."""
BLOCK = 1024
"""Points in a row."""
DIGEST_BYTES = 16
MAX_POINTS, MAX_FEATURES, MAX_KEYFRAMES = 5_000_000, 20_000, 100_000
"""More are no map of ours."""
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
            file.execute("INSERT INTO head VALUES (0, ?, ?)", _signed(head_json(site)))
            for n, each in enumerate(site.parts):
                file.execute("INSERT INTO part VALUES (?, ?, ?)", (n, *_signed(part_json(each))))
            for key, which in zip(site.keyframes, site.part_of.tolist(), strict=True):
                text, data = keyframe_json(key), packed(feature_rows(key))
                row = (key.keyframe_id, which, text, data, _digest(which, text, data))
                file.execute("INSERT INTO keyframe VALUES (?, ?, ?, ?, ?)", row)
            for first in range(0, len(site.points.positions), BLOCK):
                data = packed(point_rows(site, slice(first, first + BLOCK)))
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


def read_site_map(path: Path, far: ArrayFile | None = None) -> ReadSiteMap:
    """Read a site map as far as it is whole; SiteMapError where nothing of it can be used.

    With `far`, features and patches go there, as far as it takes them, not into memory.
    """
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
                if far is not None:
                    put_away(found[0], far)
                keyframes.append(found[0])
                part_of.append(found[1])
    if not keyframes:
        raise SiteMapError(f"{path}: it is damaged: none of its {n_keyframes} keyframes is whole")
    lost = np.isnan(rows["positions"][:, 0])
    for keyframe in keyframes:  # what observes a point of a lost block observes none
        ids = keyframe.point_ids
        ids[(ids >= 0) & lost[ids]] = -1
    points = point_arrays(rows)
    kept = None if far is None else far.put([points.patch_grey])
    if kept is not None:
        points = points._replace(patch_grey=kept[0])
    site = SiteMap(
        head.revision, head.parts, tuple(keyframes), np.array(part_of, np.int64),
        points, covariances_of(rows), head.georeference,
        head.scale_factor, head.n_levels, is_in_file=kept is not None,
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
            parts.append(site_part_of(json.loads(_checked(row))))
        out = head_of(head, tuple(parts))
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


def _row(file: sqlite3.Connection, query: str, key: int) -> Any:
    try:
        return file.execute(query, (key,)).fetchone()
    except sqlite3.Error:  # a damaged page
        return None


def _rows(
    file: sqlite3.Connection, data: bytes, of: np.dtype[np.void], most: int
) -> NDArray[np.void] | None:
    """Rows of their bytes, `most` at most; None where they are none."""
    (version,) = file.execute("PRAGMA user_version").fetchone()
    try:
        rows = np.frombuffer(data, of) if version == 1 else unpacked(data, of, most)
    except ValueError:
        return None
    return rows if len(rows) <= most else None


def _points(file: sqlite3.Connection, head: SiteHead, damaged: list[str]) -> NDArray[np.void]:
    rows = np.zeros(head.n_points, POINT)
    for first in range(0, head.n_points, BLOCK):
        row = _row(file, "SELECT data, digest FROM points WHERE id = ?", first)
        own = rows[first : first + BLOCK]
        found = None
        if row is not None and _digest(first, row[0]) == row[1]:
            found = _rows(file, row[0], POINT, BLOCK)
        if found is None or len(found) != len(own):
            damaged.append(f"points {first} to {first + len(own) - 1}")
            own["positions"] = np.nan
        else:
            own[:] = found
    return rows


def _keyframe(
    file: sqlite3.Connection, key: int, head: SiteHead, n_points: int
) -> tuple[Keyframe, int] | None:
    """A keyframe and its part; None where it is damaged."""
    query = "SELECT part, json, features, digest FROM keyframe WHERE id = ?"
    row = _row(file, query, key)
    if row is None or _digest(*row[:3]) != row[3]:
        return None
    part, said, rows = row[0], json.loads(row[1]), _rows(file, row[2], FEATURE, MAX_FEATURES)
    if rows is None or not len(rows) or not 0 <= part < len(head.parts):
        return None
    if rows["point_ids"].max() >= n_points:
        return None
    return keyframe_of(key, said, rows, head.parts[part].camera, head.scale_factor), part
