"""Tables of a site map's file: rows with a check each.

A row is read and checked as a whole when the map is opened. What a keyframe saw, and the patches of
points, are packed bytes of it, which are inflated when they are first used.
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote
from weakref import finalize

import numpy as np
from numpy.typing import NDArray

from companion.errors import InputError
from companion.messages import Bytes
from companion.products.site_map_rows import (
    FEATURE,
    OBSERVED,
    PATCH,
    POINT,
    WHOLE_FEATURE,
    WHOLE_POINT,
    observed_before,
    unpacked,
)
from companion.slam.loop.place_recognition import PlaceBlock

APPLICATION_ID = 0x534D4150
"""SQLite's application_id: SMAP."""
VERSION = 3
"""SQLite's user_version; a newer one is refused. Versions before 3 have a BLAKE2b digest of each
row, no index of places, and whole features and points, which version 1 does not pack."""
FIRST_SPLIT = 3
BLOCK, BLOCK_BEFORE = 128, 1024
"""Points in a row, and in one of a version before 3: the patches of a row are inflated as one."""
DIGEST_BYTES = 16
Packed = bytes | memoryview
"""Bytes of rows, as they lie in a file of ours."""
DAMAGED = (sqlite3.Error, UnicodeDecodeError)
"""A damaged page; and a message about it, in which the damaged bytes are quoted."""
MAX_FEATURES = 20_000
"""More are no keyframe of ours."""
SCHEMA = f"""
PRAGMA application_id = {APPLICATION_ID};
PRAGMA user_version = {VERSION};
CREATE TABLE head (id INTEGER PRIMARY KEY, json TEXT NOT NULL, checksum INTEGER NOT NULL);
CREATE TABLE part (id INTEGER PRIMARY KEY, json TEXT NOT NULL, checksum INTEGER NOT NULL);
CREATE TABLE keyframe (
  id INTEGER PRIMARY KEY, part INTEGER NOT NULL, json TEXT NOT NULL, observed BLOB NOT NULL,
  features BLOB NOT NULL, checksum INTEGER NOT NULL);
CREATE TABLE points (
  id INTEGER PRIMARY KEY, data BLOB NOT NULL, patches BLOB NOT NULL, checksum INTEGER NOT NULL);
CREATE TABLE places (
  id INTEGER PRIMARY KEY, rows BLOB NOT NULL, owners BLOB NOT NULL, marks BLOB NOT NULL,
  begins BLOB NOT NULL, checksum INTEGER NOT NULL);
"""


class SiteMapError(InputError):
    """A site map cannot be read; the reason in words."""


def checksum(values: Sequence[Any]) -> int:
    """CRC-32 of the values of a row: four times as fast as a digest, and nobody forges a map."""
    data = [value if isinstance(value, bytes) else str(value).encode() for value in values]
    total = zlib.crc32(repr([len(each) for each in data]).encode())
    for each in data:
        total = zlib.crc32(each, total)
    return total


def insert(file: sqlite3.Connection, table: str, *values: Any) -> None:
    """Insert a row of a new map, and its checksum."""
    places = ", ".join("?" * (len(values) + 1))
    file.execute(f"INSERT INTO {table} VALUES ({places})", (*values, checksum(values)))


class SiteMapTables:
    """The tables of a file that nobody changes while it is read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.is_file():
            raise SiteMapError(f"{path}: there is no such file; wanted is the site.map of a run")
        self._began = path.stat()
        try:
            self._file = sqlite3.connect(f"file:{quote(str(path.resolve()))}?immutable=1", uri=True)
            finalize(self, self._file.close)
            self._file.text_factory = bytes
            self._file.execute("PRAGMA cache_size = 1")  # rows are hardly ever read twice
            (application,) = self._file.execute("PRAGMA application_id").fetchone()
            (self.version,) = self._file.execute("PRAGMA user_version").fetchone()
        except DAMAGED as error:
            raise SiteMapError(f"{path}: it is no site map, or damaged: {error}") from error
        if application != APPLICATION_ID:
            raise SiteMapError(f"{path}: it is no site map")
        if self.version > VERSION:
            raise SiteMapError(
                f"{path}: it is of version {self.version}, and this program reads up to {VERSION}: "
                "use the companion that wrote it, or a newer one"
            )
        self._is_split = self.version >= FIRST_SPLIT
        self.block = BLOCK if self._is_split else BLOCK_BEFORE
        self._digest = _blake2b()

    @property
    def digest(self) -> str:
        """BLAKE2b digest of the rows that were found whole; of a version before 3, of the file."""
        if self._is_split:
            return str(self._digest.hexdigest())
        digest = _blake2b()
        with self.path.open("rb") as file:
            while data := file.read(1 << 20):
                digest.update(data)
        return str(digest.hexdigest())

    def check_unchanged(self) -> None:
        """SiteMapError where the file was written to since it was opened.

        Another file in its place, or none, does no harm: this one is open.
        """
        try:
            now, then = self.path.stat(), self._began
        except FileNotFoundError:
            return
        if now.st_ino == then.st_ino and (now.st_mtime_ns, now.st_size) != (
            then.st_mtime_ns, then.st_size,
        ):  # fmt: skip
            raise SiteMapError(f"{self.path}: it was written to while it was read")

    def row(self, table: str, key: int) -> tuple[Any, ...] | None:
        """A row but for its check, None where it is damaged."""
        try:
            query = f"SELECT * FROM {table} WHERE id = ?"
            row = self._file.execute(query, (key,)).fetchone()
        except DAMAGED:
            return None
        if row is None:
            return None
        *values, check = row
        if not self._is_split:
            found: Any = _digest_before(values if table == "points" else values[1:])
        else:
            found = checksum(values)
        if found != check:
            return None
        self._digest.update(f"{table} {key} {check}\0".encode())
        return tuple(values)

    def keyframe(self, key: int) -> tuple[int, dict[str, Any], NDArray[np.void], bytes] | None:
        """Part, JSON, OBSERVED rows and packed features of a keyframe; None where it is damaged."""
        row = self.row("keyframe", key)
        if row is None:
            return None
        said = json.loads(row[2])
        if self._is_split:
            return row[1], said, np.frombuffer(row[3], OBSERVED), row[4]
        try:
            whole = features_in(self.version, row[3])
        except ValueError:
            return None
        return row[1], said | {"n_features": len(whole)}, observed_before(whole), row[3]

    def points(self, first: int) -> tuple[NDArray[np.void], bytes] | None:
        """POINT rows of a block of points and their packed patches; None where it is damaged."""
        row = self.row("points", first)
        if row is None:
            return None
        try:
            rows = _rows(self.version, row[1], POINT, WHOLE_POINT, self.block)
        except ValueError:
            return None
        return rows if self._is_split else rows[list(POINT.names or ())], row[-1]

    def places(self, n: int) -> PlaceBlock | None:
        """A block of the index of places; None where it is damaged."""
        row = self.row("places", n)
        if row is None:
            return None
        arrays = (
            np.frombuffer(data, of)
            for data, of in zip(row[1:], (np.int32, np.uint8, np.uint64, np.uint32), strict=True)
        )
        return PlaceBlock(*arrays)


def features_in(version: int, data: Packed) -> NDArray[np.void]:
    """FEATURE rows of a keyframe of a version's file; ValueError where they are none."""
    return _rows(version, data, FEATURE, WHOLE_FEATURE, MAX_FEATURES)


def patches_in(version: int, data: Packed) -> Bytes:
    """Patches of a block of points of a version's file; ValueError where they are none."""
    block = BLOCK if version >= FIRST_SPLIT else BLOCK_BEFORE
    return np.asarray(_rows(version, data, PATCH, WHOLE_POINT, block)["patch_grey"])


def _rows(
    version: int, data: Packed, of: np.dtype[np.void], before: np.dtype[np.void], most: int
) -> NDArray[np.void]:
    """Rows of their bytes, `most` at most, which were `before` in versions before 3."""
    of = of if version >= FIRST_SPLIT else before
    rows = np.frombuffer(data, of) if version == 1 else unpacked(data, of, most)
    if len(rows) > most:
        raise ValueError("there are more rows than a map of ours has")
    return rows


def _blake2b() -> Any:
    return hashlib.blake2b(digest_size=DIGEST_BYTES)


def _digest_before(values: Sequence[Any]) -> bytes:
    """Check of a row before version 3."""
    digest = _blake2b()
    for value in values:
        digest.update(value if isinstance(value, bytes) else str(value).encode())
        digest.update(b"\0")
    return bytes(digest.digest())
