"""The site map that a flight leaves: its largest map with a scale, with how well it is placed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from companion.estimation.georeference.trajectory_alignment import DRIFT_TAU_S, SIGMA_DRIFT_M
from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.messages import Georeference
from companion.slam.map.site_map import (
    SiteAccount,
    SiteGeoreference,
    SiteMap,
    SitePart,
    site_map_of,
)
from companion.slam.map.sparse_map import SlamMap
from companion.slam.mapping.site_fading import faded


def site_of_flight(
    segments: Sequence[tuple[SlamMap, Georeference]], camera: Camera, flight: str,
    origin: GeoOrigin | None, used: SiteAccount | None,
) -> SiteMap | None:  # fmt: skip
    """The site map of the largest of some maps; None of none.

    `flight` is its name, `origin` that of its local NED. Keyframes of an earlier site map that it
    was merged with, `used`, stay those of their flights; points of it that this one looks through
    are left out.
    """
    if not segments:
        return None
    segment, placed = max(segments, key=lambda each: len(each[0].keyframes))
    before = used if segment.held and used is not None else None
    part_of_id = {} if before is None else before.part_of_id
    times = [k.t_ns for key, k in segment.keyframes.items() if key not in part_of_id]
    parts = () if before is None else before.parts
    revision = 1 if before is None else before.revision + 1
    if times:
        parts = (*parts, SitePart(flight, min(times), camera, revision))
    georeference = SiteGeoreference(
        _origin(origin, placed, before),
        _sigma_m(times) if before is None else before.georeference.sigma_m,
        placed.sigma_yaw_rad, placed.sigma_scale, placed.method,
    )  # fmt: skip
    site = site_map_of(segment, placed.world_from_map, parts, part_of_id, georeference, revision)
    return site if before is None else faded(site)


def _origin(
    of_flight: GeoOrigin | None, placed: Georeference, before: SiteAccount | None
) -> GeoOrigin | None:
    """Origin of the world that a map lies in; where it was merged, that is as the earlier one."""
    if before is None:
        return of_flight if placed.has_origin else None
    of_map = before.georeference.origin
    return of_map and (of_flight or of_map)


def _sigma_m(times_ns: list[int]) -> float:
    """Standard deviation of the place of a map by satellites, whose error drifts while it flies."""
    flown_s = (max(times_ns) - min(times_ns)) * 1e-9
    return SIGMA_DRIFT_M * float(np.sqrt(min(1.0, 2.0 * DRIFT_TAU_S / max(flown_s, 1.0))))
