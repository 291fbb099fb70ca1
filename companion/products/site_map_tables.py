"""Tables of a site map's file: rows with a check each, and arrays that are read when they are used.

A row is read and checked as a whole when the map is opened. What a keyframe saw, and the patches of
points, are inflated when they are first used.
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
import threading
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
    """The tables of a file that nobody changes, as it is replaced as a whole."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.Lock()
        """Tracking and mapping read what they use, each in a thread of its own."""
        if not path.is_file():
            raise SiteMapError(f"{path}: there is no such file; wanted is the site.map of a run")
        try:
            self._file = sqlite3.connect(
                f"file:{quote(str(path.resolve()))}?immutable=1", uri=True, check_same_thread=False
            )
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

    def row(self, table: str, key: int, is_first: bool = True) -> tuple[Any, ...] | None:
        """A row but for its check, None where it is damaged; the digest is of rows read first."""
        try:
            with self._lock:
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
        if is_first:
            self._digest.update(f"{table} {key} {check}\0".encode())
        return tuple(values)

    def keyframe(self, key: int) -> tuple[int, dict[str, Any], NDArray[np.void]] | None:
        """Part, JSON and OBSERVED rows of a keyframe; None where it is damaged."""
        row = self.row("keyframe", key)
        if row is None:
            return None
        said = json.loads(row[2])
        if self._is_split:
            return row[1], said, np.frombuffer(row[3], OBSERVED)
        whole = self._unpacked(row[3], FEATURE, WHOLE_FEATURE, MAX_FEATURES)
        if whole is None:
            return None
        return row[1], said | {"n_features": len(whole)}, observed_before(whole)

    def features(self, key: int) -> NDArray[np.void]:
        """FEATURE rows of a keyframe; SiteMapError where it is damaged."""
        row = self.row("keyframe", key, is_first=False)
        of = FEATURE, WHOLE_FEATURE
        rows = None if row is None else self._unpacked(row[-1], *of, MAX_FEATURES)
        if rows is None:
            raise SiteMapError(f"{self.path}: keyframe {key} is damaged")
        return rows

    def points(self, first: int) -> NDArray[np.void] | None:
        """POINT rows of a block of points; None where it is damaged."""
        row = self.row("points", first)
        rows = None if row is None else self._unpacked(row[1], POINT, WHOLE_POINT, self.block)
        return None if rows is None else rows[list(POINT.names or ())]

    def patches(self, first: int) -> Bytes:
        """Patches of a block of points; SiteMapError where it is damaged."""
        row = self.row("points", first, is_first=False)
        rows = None if row is None else self._unpacked(row[-1], PATCH, WHOLE_POINT, self.block)
        if rows is None:
            raise SiteMapError(f"{self.path}: points from {first} on are damaged")
        return np.asarray(rows["patch_grey"])

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

    def _unpacked(
        self, data: bytes, of: np.dtype[np.void], whole: np.dtype[np.void], most: int
    ) -> NDArray[np.void] | None:
        """Rows of their bytes, `most` at most, which were `whole` before; None if none."""
        of = of if self._is_split else whole
        try:
            rows = np.frombuffer(data, of) if self.version == 1 else unpacked(data, of, most)
        except ValueError:
            return None
        return rows if len(rows) <= most else None


def _blake2b() -> Any:
    return hashlib.blake2b(digest_size=DIGEST_BYTES)


def _digest_before(values: Sequence[Any]) -> bytes:
    """Check of a row before version 3."""
    digest = _blake2b()
    for value in values:
        digest.update(value if isinstance(value, bytes) else str(value).encode())
        digest.update(b"\0")
    return bytes(digest.digest())
