"""File of a site map: SQLite, with a check for each keyframe and each block of points.

It is written beside its place, synchronised, and moved there in one step, so that a loss of power
leaves the old file or the new one. A damaged file is read as far as its keyframes and blocks are
whole; without head and calibrations it is refused.
"""

from __future__ import annotations

import json
import os
import sqlite3
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from companion.messages import Bytes
from companion.products.array_file import ArrayFile
from companion.products.atomic_file import sync
from companion.products.site_map_rows import (
    PATCH,
    POINT,
    SiteHead,
    covariances_of,
    feature_rows,
    head_json,
    head_of,
    keyframe_json,
    keyframe_of,
    observed_rows,
    packed,
    part_json,
    patch_rows,
    point_arrays,
    point_rows,
    seen_of,
    site_part_of,
)
from companion.products.site_map_tables import (
    BLOCK,
    MAX_FEATURES,
    SCHEMA,
    Packed,
    SiteMapError,
    SiteMapTables,
    features_in,
    insert,
    patches_in,
)
from companion.slam.loop.place_recognition import PlaceBlock, place_blocks
from companion.slam.map.patch_store import PatchesLater, PatchRows
from companion.slam.map.seen import Seen, SeenLater
from companion.slam.map.site_map import SiteMap
from companion.slam.map.sparse_map import Keyframe
from companion.slam.mapping.far_keyframes import put_away

SITE_MAP = "site.map"
"""Its name in the folder of a run."""
MAX_POINTS, MAX_KEYFRAMES, MAX_PLACES = 5_000_000, 100_000, 1_000
"""More are no map of ours."""


@dataclass(frozen=True, slots=True, eq=False)
class ReadSiteMap:
    """A site map as read, and what of it was damaged.

    `places` is its index, none where it has to be made of its keyframes; by `digest` a flight's
    recording knows the map that it used.
    """

    site: SiteMap
    damaged: tuple[str, ...]
    places: tuple[PlaceBlock, ...]
    digest: str


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
            for n, each in enumerate(site.parts):
                insert(file, "part", n, part_json(each))
            for key, which in zip(site.keyframes, site.part_of.tolist(), strict=True):
                rows = observed_rows(key).tobytes(), packed(feature_rows(key))
                insert(file, "keyframe", key.keyframe_id, which, keyframe_json(key), *rows)
            for first in range(0, len(site.points.positions), BLOCK):
                own = slice(first, first + BLOCK)
                rows = packed(point_rows(site, own)), packed(patch_rows(site, own))
                insert(file, "points", first, *rows)
            n_places = 0
            for block in place_blocks(
                (k.keyframe_id, k.features.descriptors) for k in site.keyframes
            ):
                insert(file, "places", n_places, *(each.tobytes() for each in block))
                n_places += 1
            insert(file, "head", 0, head_json(site, n_places))
            file.execute("COMMIT")
        sync(part)
        os.replace(part, path)
        sync(path.parent)
    except sqlite3.Error as error:
        raise OSError(0, f"{error}", str(path)) from error
    finally:
        part.unlink(missing_ok=True)


def read_head(path: Path) -> SiteHead:
    """The head of a file; SiteMapError where it cannot be read."""
    return _head_of(SiteMapTables(path))


def read_site_map(path: Path, far: ArrayFile | None = None) -> ReadSiteMap:
    """Read a site map as far as it is whole; SiteMapError where nothing of it can be used.

    With `far`, packed features and patches go there, as far as it takes them, not into memory. They
    are inflated as they are used, whatever has become of the file since.
    """
    tables = SiteMapTables(path)
    head, damaged = _head_of(tables), list[str]()
    rows, patches = _points(tables, head, far, damaged)
    keyframes, part_of = [], []
    for n in range(head.n_keyframes):
        found = _keyframe(tables, n, head, far)
        if found is None:
            damaged.append(f"keyframe {n}")
        else:
            keyframes.append(found[0])
            part_of.append(found[1])
    if not keyframes:
        raise SiteMapError(
            f"{path}: it is damaged: none of its {head.n_keyframes} keyframes is whole"
        )
    lost = np.isnan(rows["positions"][:, 0])
    if lost.any():  # what observes a point of a lost block observes none
        for keyframe in keyframes:
            ids = keyframe.point_ids
            ids[(ids >= 0) & lost[ids]] = -1
    places = [tables.places(n) for n in range(head.n_places)]
    damaged += [f"index of places, block {n}" for n, each in enumerate(places) if each is None]
    tables.check_unchanged()
    site = SiteMap(
        head.revision, head.parts, tuple(keyframes), np.array(part_of, np.int64),
        point_arrays(rows, patches), covariances_of(rows), head.georeference,
        head.scale_factor, head.n_levels, is_in_file=far is not None,
    )  # fmt: skip
    # an index names keyframes that are damaged as well
    index = () if damaged else tuple(each for each in places if each is not None)
    return ReadSiteMap(site, tuple(damaged), index, tables.digest)


def _head_of(tables: SiteMapTables) -> SiteHead:
    path = tables.path
    try:
        head = json.loads(_text(tables, "head", 0))
        parts = [
            site_part_of(json.loads(_text(tables, "part", n))) for n in range(int(head["n_parts"]))
        ]
        out = head_of(head, tuple(parts))
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise SiteMapError(f"{path}: its head is damaged ({error})") from error
    within = (
        0 < out.n_keyframes <= MAX_KEYFRAMES
        and 0 <= out.n_points <= MAX_POINTS
        and 0 <= out.n_places <= MAX_PLACES
    )
    if not (within and out.parts and 1.0 < out.scale_factor <= 2.0 and 1 <= out.n_levels <= 16):
        raise SiteMapError(f"{path}: its head is not that of a site map")
    return out


def _text(tables: SiteMapTables, table: str, key: int) -> bytes:
    row = tables.row(table, key)
    if row is None:
        raise ValueError("a row is missing, or its checksum is not its own")
    return bytes(row[1])


def _points(
    tables: SiteMapTables, head: SiteHead, far: ArrayFile | None, damaged: list[str]
) -> tuple[NDArray[np.void], PatchRows]:
    """Points, nan where they are damaged, and their patches."""
    rows, packed_patches = np.zeros(head.n_points, POINT), dict[int, Packed]()
    for first in range(0, head.n_points, tables.block):
        own = rows[first : first + tables.block]
        found = tables.points(first)
        if found is None or len(found[0]) != len(own):
            damaged.append(f"points {first} to {first + len(own) - 1}")
            own["positions"] = np.nan
        else:
            own[:] = found[0]
            packed_patches[first] = found[1] if far is None else _put(far, found[1])
    version = tables.version
    if far is not None:

        def read(first: int) -> Bytes:
            grey = patches_in(version, packed_patches[first])
            kept = far.put([grey])
            return grey if kept is None else np.asarray(kept[0])

        return rows, PatchesLater(len(rows), tables.block, read)
    grey = np.zeros(len(rows), PATCH)["patch_grey"]
    for first, data in packed_patches.items():
        own_grey = grey[first : first + tables.block]
        try:
            own_grey[:] = patches_in(version, data)
        except ValueError:
            damaged.append(f"patches {first} to {first + len(own_grey) - 1}")
            rows["positions"][first : first + tables.block] = np.nan
    return rows, grey


def _put(far: ArrayFile, data: bytes) -> Packed:
    kept = far.put([np.frombuffer(data, np.uint8)])
    return data if kept is None else memoryview(kept[0])


def _keyframe(
    tables: SiteMapTables, key: int, head: SiteHead, far: ArrayFile | None
) -> tuple[Keyframe, int] | None:
    """A keyframe and its part; None where it is damaged."""
    found = tables.keyframe(key)
    if found is None:
        return None
    part, said, observed, data = found
    n_features = said["n_features"]
    if not (0 < n_features <= MAX_FEATURES and 0 <= part < len(head.parts)):
        return None
    if len(observed) and not (
        observed["feature"].max() < n_features
        and 0 <= observed["point"].min()
        and observed["point"].max() < head.n_points
    ):
        return None
    camera, version = head.parts[part].camera, tables.version
    lies = data if far is None else _put(far, data)

    def read() -> Seen:
        rows = features_in(version, lies)
        if len(rows) != n_features:
            raise ValueError("the number of features is another one")
        seen = seen_of(rows, camera, head.scale_factor)
        return seen if far is None else put_away(seen, far)

    try:
        seen = read() if far is None else SeenLater(read)
    except ValueError:
        return None
    return keyframe_of(key, said, observed, seen), part
