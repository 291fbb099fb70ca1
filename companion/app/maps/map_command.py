"""companion map: site maps of flights, shown, verified, exported, kept and merged."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from companion.app.maps.merged_maps import merged_map
from companion.errors import InputError
from companion.estimation.site.site_use import contradiction, world_from_site
from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Similarity
from companion.products.atomic_file import write_atomically
from companion.products.cloud import Cloud
from companion.products.cloud_ply import ply_parts
from companion.products.flight_result import WorldPose
from companion.products.report.batch_page import MergedFlight
from companion.products.site_map_file import (
    ReadSiteMap,
    map_path,
    read_head,
    read_site_map,
    write_site_map,
)
from companion.products.site_map_rows import SiteHead
from companion.products.trajectory_file import trajectory_tum
from companion.slam.loop.loop_closure import MIN_SHARED
from companion.slam.map.site_flights import pixel_m
from companion.slam.map.site_map import SiteMap
from companion.slam.mapping.site_merge import merge_sites, shared_points
from companion.slam.mapping.site_prune import prune_site

BYTES_PER_MB = 1e6


def show(path: Path, as_json: bool) -> str:
    """The head of a map: what it is of, how well it is placed, its parts."""
    path = map_path(path)
    head = read_head(path)
    if as_json:
        return json.dumps(_head_numbers(path, head), indent=2)
    found, origin = head.georeference, head.georeference.origin
    size_mb = path.stat().st_size / BYTES_PER_MB
    placed = (
        "no place on the globe: level and scale only"
        if origin is None
        else f"origin {origin.latitude_deg:.7f} {origin.longitude_deg:.7f}, "
        f"{origin.altitude_m:.1f} m above sea level, within {found.sigma_m:.2f} m"
    )
    lines = [
        f"{path}: revision {head.revision}, {head.n_keyframes} keyframes, {head.n_points} points, "
        f"{size_mb:.1f} MB",
        placed,
        f"scale within {100 * found.sigma_scale:.2f} %, heading within "
        f"{np.degrees(found.sigma_yaw_rad):.2f} degrees, by {found.method}",
    ]
    for part in head.parts:
        camera = part.camera
        lines.append(
            f"since revision {part.revision}: {part.flight}, camera "
            f"{camera.width}x{camera.height}, "
            f"focal length {camera.focal_px:.1f} pixels"
        )
    return "\n".join(lines)


def verify(path: Path) -> tuple[str, bool]:
    """A line for each fault of a map, or that it is whole; True if it is."""
    path = map_path(path)
    read = read_site_map(path)
    faults = [f"{each} is damaged" for each in read.damaged]
    if wrong := contradiction(read.site):
        faults.append(wrong)
    return "\n".join(f"{path}: {each}" for each in faults or ["whole"]), not faults


def export(path: Path, out: Path) -> list[Path]:
    """Write points.ply, keyframes.tum and map.json of a map into a folder; their paths."""
    path = map_path(path)
    read = read_site_map(path)
    origin = read.site.georeference.origin
    poses = [
        WorldPose(k.keyframe_id, k.t_ns, k.camera_from_map.inverse()) for k in read.site.keyframes
    ]
    numbers = _head_numbers(path, read_head(path)) | {"damaged": list(read.damaged)}
    files: dict[str, Any] = {
        "points.ply": b"".join(ply_parts(_cloud(read.site), "m", origin)),
        "keyframes.tum": trajectory_tum(poses, "m", origin),
        "map.json": (json.dumps(numbers, indent=2) + "\n").encode(),
    }
    for name, data in files.items():
        write_atomically(out / name, data)
    return [out / name for name in files]


def save(path: Path, out: Path) -> ReadSiteMap:
    """Keep the map of a run as a file of its own, as far as it is whole."""
    read = read_site_map(map_path(path))
    write_site_map(out, read.site)
    return read


def prune(path: Path, out: Path, spacing_deg: float) -> str:
    """Write a map without redundant keyframes; a line about what is left."""
    path = map_path(path)
    site, whole_mb = read_site_map(path).site, path.stat().st_size / BYTES_PER_MB
    pruned = prune_site(site, spacing_deg)
    write_site_map(out, pruned)
    return (
        f"{len(pruned.keyframes)} of {len(site.keyframes)} keyframes and "
        f"{len(pruned.points.positions)} of {len(site.points.positions)} points left, "
        f"{out.stat().st_size / BYTES_PER_MB:.1f} of {whole_mb:.1f} MB"
    )


@dataclass(frozen=True, slots=True)
class Moved:
    """Motion of the keyframes of a map as it became one with another: as a whole, and besides.

    `rest_m` is RMS.
    """

    flights: tuple[str, ...]
    whole_m: float
    rest_m: float


@dataclass(frozen=True, slots=True)
class Join:
    """A map that was added to those before it.

    `n_shared` points are observed by both. With `by_one_place` they are too few to bind the two,
    which then rests on the place where they were joined.
    """

    map: str
    n_shared: int
    by_one_place: bool
    moved: tuple[Moved, ...]


def merge(paths: Sequence[Path], out: Path, as_json: bool = False) -> str:
    """Merge maps into a new file; how they were joined, and what each flight gave.

    They are joined from the coarsest to the finest, as `merge_sites` wants it, as far as each shows
    a place of those before. InputError where one shows none, or too little of one.
    """
    left = [(path, read_site_map(map_path(path)).site) for path in paths]
    left.sort(key=lambda each: -pixel_m(each[1]))
    (first, merged), *left = left
    for path, site in left:
        if (site.scale_factor, site.n_levels) != (merged.scale_factor, merged.n_levels):
            raise InputError(f"{path}: it was made with other features.scale_factor or n_levels")
    joins: list[Join] = []
    while left:
        for n, (path, other) in enumerate(left):
            apart = world_from_site(other.georeference.origin, merged.georeference.origin)
            try:
                both = merge_sites(merged, other, apart)
            except InputError as error:
                raise InputError(f"{path}: {error}") from error
            if both is not None:
                joins.append(_joined(path, merged, other, both, apart))
                merged = both
                del left[n]
                break
        else:
            alone = ", ".join(str(path) for path, _ in left)
            before = ", ".join([str(first), *(each.map for each in joins)])
            raise InputError(f"{alone}: no place in it is seen in {before}")
    write_site_map(out, merged)
    made = merged_map(str(out), merged)
    if as_json:
        return json.dumps({"joins": [asdict(each) for each in joins], **asdict(made)}, indent=2)
    return "\n".join([*map(_join_in_words, joins), *map(_flight_in_words, made.flights), str(out)])


def _joined(path: Path, merged: SiteMap, other: SiteMap, both: SiteMap, apart: Similarity) -> Join:
    n = len(merged.keyframes)
    n_shared = len(shared_points(both.keyframes[:n], both.keyframes[n:]))
    moved = _moved(merged, other, both, apart)
    return Join(str(path), n_shared, n_shared < MIN_SHARED, moved)


def _join_in_words(join: Join) -> str:
    bound = (
        f"joined at one place only, with {join.n_shared} points that both see"
        if join.by_one_place
        else f"bound by {join.n_shared} points that both see"
    )
    moved = (
        f"{', '.join(each.flights)} moved by {each.whole_m:.2f} m as a whole, {each.rest_m:.2f} m "
        "RMS besides"
        for each in join.moved
    )
    return "; ".join([f"{join.map}: {bound}", *moved])


def _flight_in_words(flight: MergedFlight) -> str:
    apart = (
        "too few to tell how far apart"
        if flight.apart_m is None
        else f"{flight.apart_m:.3f} m apart there (one axis)"
    )
    return (
        f"{flight.flight} gave {flight.path_m:.0f} m, {flight.n_keyframes} keyframes, "
        f"{flight.n_points} points; {flight.n_shared} are seen by other flights, {apart}"
    )


def _moved(before: SiteMap, other: SiteMap, both: SiteMap, apart: Similarity) -> tuple[Moved, ...]:
    now = np.stack([k.camera_from_map.inverse().translation for k in both.keyframes])
    out = []
    for site, in_world, places in (
        (before, Similarity.identity(), now[: len(before.keyframes)]),
        (other, apart, now[len(before.keyframes) :]),
    ):
        then = in_world.apply(
            np.stack([k.camera_from_map.inverse().translation for k in site.keyframes])
        )
        off = places - then
        rest_m = float(np.sqrt(((off - off.mean(0)) ** 2).sum(1).mean()))
        flights = tuple(part.flight for part in site.parts)
        out.append(Moved(flights, float(np.linalg.norm(off.mean(0))), rest_m))
    return tuple(out)


def _head_numbers(path: Path, head: SiteHead) -> dict[str, Any]:
    found = head.georeference
    return {
        "revision": head.revision, "keyframes": head.n_keyframes, "points": head.n_points,
        "bytes": path.stat().st_size, "origin": _origin_numbers(found.origin),
        "sigma_m": found.sigma_m, "sigma_yaw_deg": float(np.degrees(found.sigma_yaw_rad)),
        "sigma_scale": found.sigma_scale, "scale_by": found.method,
        "parts": [
            {
                "flight": part.flight, "began_ns": part.began_ns, "revision": part.revision,
                "image": [part.camera.width, part.camera.height],
                "focal_px": part.camera.focal_px,
            }
            for part in head.parts
        ],
    }  # fmt: skip


def _origin_numbers(origin: GeoOrigin | None) -> dict[str, float] | None:
    if origin is None:
        return None
    return {
        "latitude_deg": origin.latitude_deg, "longitude_deg": origin.longitude_deg,
        "altitude_m": origin.altitude_m,
    }  # fmt: skip


def _cloud(site: SiteMap) -> Cloud:
    """Points whose error is known, grey as in the image that they were found in."""
    variance = site.covariances.trace(axis1=1, axis2=2)
    known = np.isfinite(variance) & np.isfinite(site.points.positions).all(1)
    patches = site.points.patch_grey[known]
    grey = patches[:, patches.shape[1] // 2, patches.shape[2] // 2]
    found = site.points.n_found[known] / np.maximum(site.points.n_visible[known], 1)
    return Cloud(
        site.points.positions[known], np.repeat(grey[:, None], 3, 1),
        np.clip(found, 0.0, 1.0).astype(np.float32),
        site.points.normals[known].astype(np.float32),
        np.sqrt(variance[known]).astype(np.float32),
    )  # fmt: skip
