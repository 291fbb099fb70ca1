"""Changes between two site maps as data for other programs: numbers, GeoJSON, a coloured cloud."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from companion.geometry.geodesy import GeoOrigin, geodetic_from_ned
from companion.products.cloud import Cloud
from companion.slam.mapping.site_change import SiteChange, SiteComparison

COLOURS = {"gone": (214, 69, 69), "new": (44, 154, 87), "moved": (11, 107, 203)}


def change_numbers(found: SiteComparison, origin: GeoOrigin | None) -> dict[str, Any]:
    """The comparison as JSON; NED metres about the origin of the first map."""
    return {
        "origin": None if origin is None else
            [origin.latitude_deg, origin.longitude_deg, origin.altitude_m],
        "points_of_both": found.n_shared,
        "apart_m": None if found.apart_m is None else round(found.apart_m, 4),
        "points": list(found.n_points), "points_at_places_seen_by_both": list(found.n_looked),
        "changes": [_numbers(each) for each in found.changes],
    }  # fmt: skip


def _numbers(change: SiteChange) -> dict[str, Any]:
    return {
        "kind": change.kind, "centre_m": _rounded(change.centre_m),
        "size_m": _rounded(change.size_m), "points": len(change.points_m),
        "keyframes_that_look_through": change.n_views,
        "threshold_m": round(change.threshold_m, 3),
        "moved_m": None if change.moved_m is None else _rounded(change.moved_m),
    }  # fmt: skip


def change_geojson(found: SiteComparison, origin: GeoOrigin) -> bytes:
    """RFC 7946: a point for each change, heights above sea level, with its numbers."""
    features = []
    for change in found.changes:
        ((lat, lon, height),) = geodetic_from_ned(change.centre_m[None], origin).tolist()
        features.append({
            "type": "Feature",
            "geometry": {
                "type": "Point", "coordinates": [round(lon, 9), round(lat, 9), round(height, 3)]
            },
            "properties": _numbers(change),
        })  # fmt: skip
    return (json.dumps({"type": "FeatureCollection", "features": features}) + "\n").encode()


def change_cloud(found: SiteComparison) -> Cloud:
    """All points of changes, red where gone, green where new, blue where moved from."""
    points = [each.points_m for each in found.changes]
    n = sum(map(len, points))
    rgb = [
        np.tile(np.array(COLOURS[c.kind], np.uint8), (len(c.points_m), 1)) for c in found.changes
    ]
    return Cloud(
        np.concatenate([np.zeros((0, 3)), *points]).astype(np.float32),
        np.concatenate([np.zeros((0, 3), np.uint8), *rgb]), np.ones(n, np.float32),
        np.zeros((n, 3), np.float32), np.full(n, np.nan, np.float32),
    )  # fmt: skip


def _rounded(values: Any) -> list[float]:
    return [round(float(v), 3) for v in values]
