"""Camera path in geodetic coordinates: GPX, KML and GeoJSON (WGS84, heights above sea level)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from xml.sax.saxutils import escape

import numpy as np

from companion.geometry.geodesy import GeoOrigin, geodetic_from_ned
from companion.geometry.transforms import Array
from companion.products.flight_result import WorldPose


def places_of(poses: Sequence[WorldPose], origin: GeoOrigin) -> Array:
    """Latitude, longitude and height (N, 3) of the camera; degrees and metres."""
    if not poses:
        return np.zeros((0, 3))
    ned = np.stack([pose.world_from_camera.translation for pose in poses])
    return geodetic_from_ned(ned, origin)


def path_gpx(poses: Sequence[WorldPose], origin: GeoOrigin, name: str) -> bytes:
    """GPX 1.1: one track."""
    points = "".join(
        f'<trkpt lat="{lat:.9f}" lon="{lon:.9f}"><ele>{height:.3f}</ele>'
        f"<time>{utc(pose.t_ns)}</time></trkpt>\n"
        for pose, (lat, lon, height) in zip(poses, places_of(poses, origin), strict=True)
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<gpx version="1.1" creator="companion" xmlns="http://www.topografix.com/GPX/1/1">\n'
        f"<trk><name>{escape(name)}</name><trkseg>\n{points}</trkseg></trk>\n</gpx>\n"
    ).encode()


def path_kml(poses: Sequence[WorldPose], origin: GeoOrigin, name: str) -> bytes:
    """KML 2.2: one line with absolute heights."""
    line = "\n".join(
        f"{lon:.9f},{lat:.9f},{height:.3f}" for lat, lon, height in places_of(poses, origin)
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<kml xmlns="http://www.opengis.net/kml/2.2"><Document>\n'
        f"<name>{escape(name)}</name>\n<Placemark><name>camera</name><LineString>"
        f"<altitudeMode>absolute</altitudeMode><coordinates>\n{line}\n</coordinates>"
        "</LineString></Placemark>\n</Document></kml>\n"
    ).encode()


def path_geojson(poses: Sequence[WorldPose], origin: GeoOrigin, name: str) -> bytes:
    """RFC 7946: a LineString with the times of its positions; no geometry below two poses."""
    coordinates = [
        [round(lon, 9), round(lat, 9), round(height, 3)]
        for lat, lon, height in places_of(poses, origin).tolist()
    ]
    geometry = {"type": "LineString", "coordinates": coordinates} if len(poses) > 1 else None
    feature = {
        "type": "Feature",
        "geometry": geometry,
        "properties": {"name": name, "times": [utc(pose.t_ns) for pose in poses]},
    }
    return (json.dumps({"type": "FeatureCollection", "features": [feature]}) + "\n").encode()


def utc(t_ns: int) -> str:
    """Unix time as ISO 8601, to the millisecond.

    >>> utc(1_762_000_000_123_999_999)
    '2025-11-01T12:26:40.123Z'
    """
    return f"{np.datetime64(t_ns // 1_000_000, 'ms')}Z"
