"""Geotagged still images (EXIF) of mapping cameras as a flight."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from companion.config import CameraConfig, TelemetryConfig
from companion.errors import FlightError
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose, quaternion_from_euler
from companion.messages import Warned
from companion.telemetry import AttitudeSample, PositionSource
from drivers.datasets.flight_folder import camera_of
from drivers.flight import Flight
from drivers.images.calibration_file import FORWARD_UPRIGHT, read_calibration
from drivers.images.exif import Photo, read_photo
from drivers.images.frame_source import VIDEO_SUFFIXES, ImageFolder
from drivers.telemetry.log_readers import aligned, unchanged
from drivers.telemetry.telemetry_log import GeodeticFix, LogContent, TelemetryCollector

SUFFIXES = frozenset({".jpg", ".jpeg", ".tif", ".tiff"})
LEAST = 3
ZONE_NS = 900_000_000_000
"""Time zones are whole quarters of an hour apart."""
SECOND_NS = 1_000_000_000
SUSPECT_CLIMB_M = 20.0
SUSPECT_SHARE = 0.9


def is_geotagged(path: Path) -> bool:
    """True if a folder holds stills, without a video, and one of the first is geotagged."""
    if any(p.suffix.lower() in VIDEO_SUFFIXES for p in path.iterdir()):
        return False
    files = _files(path)
    photos = [read_photo(file) for file in files[:LEAST]]
    return len(files) >= LEAST and any(p is not None and p.latitude_deg is not None for p in photos)


def open_geotagged(path: Path, config: CameraConfig, telemetry: TelemetryConfig) -> Flight:
    """Stills in order of time; FlightError without times."""
    files = _files(path)
    found = [photo for photo in map(read_photo, files) if photo is not None]
    timed = [photo for photo in found if photo.local_ns is not None or photo.utc_ns is not None]
    if len(timed) < LEAST:
        raise FlightError(f"{path}: of {len(files)} photographs {len(timed)} have a time in EXIF")
    size, _ = Counter((photo.width, photo.height) for photo in timed).most_common(1)[0]
    timed = [photo for photo in timed if (photo.width, photo.height) == size]
    photos, times_ns = _in_order(timed)
    start_ns = times_ns[0]
    warnings = []
    if len(photos) < len(files):
        detail = f"{len(files) - len(photos)} of {len(files)}: damaged, no time, or another size"
        warnings.append(Warned(start_ns, "photographs left out", detail))
    source = ImageFolder(path, [photo.path for photo in photos])
    camera, remarks = _camera(path, photos, source, config, start_ns)
    if camera.body_from_camera is None and photos[0].gimbal_deg is not None:
        # the gimbal's angles are the camera's own: it is as if it sat forward on what turns so
        camera = replace(camera, body_from_camera=Pose(FORWARD_UPRIGHT, np.zeros(3)))
    content, more = _places(photos, times_ns)
    return Flight(
        path, camera, source, list(range(len(photos))), times_ns, [*warnings, *remarks, *more],
        lambda pictures: aligned(content, pictures, telemetry),
    )  # fmt: skip


def _files(path: Path) -> list[Path]:
    return sorted(p for p in path.iterdir() if p.suffix.lower() in SUFFIXES)


def _in_order(photos: Sequence[Photo]) -> tuple[list[Photo], list[int]]:
    """Stills in order of time and name; those of one second are spread over it."""
    offset_ns = _zone_ns(photos)
    whole = [
        (p.local_ns - offset_ns if p.local_ns is not None else p.utc_ns or 0, p) for p in photos
    ]
    order = sorted(whole, key=lambda each: (each[0], each[1].subsecond_ns or 0, each[1].path.name))
    of_second = Counter(t_ns for t_ns, _ in order)
    seen: Counter[int] = Counter()
    times_ns: list[int] = []
    for t_ns, photo in order:
        part_ns = photo.subsecond_ns
        if part_ns is None:
            part_ns = SECOND_NS * seen[t_ns] // of_second[t_ns]
        seen[t_ns] += 1
        times_ns.append(max(t_ns + part_ns, times_ns[-1] + 1_000_000 if times_ns else 0))
    return [photo for _, photo in order], times_ns


def _zone_ns(photos: Sequence[Photo]) -> int:
    """Camera clock minus satellite time, in whole quarters of an hour."""
    apart = [p.local_ns - p.utc_ns for p in photos if p.local_ns is not None and p.utc_ns]
    return round(float(np.median(apart)) / ZONE_NS) * ZONE_NS if apart else 0


def _camera(
    path: Path, photos: Sequence[Photo], source: ImageFolder, config: CameraConfig, start_ns: int
) -> tuple[Camera, list[Warned]]:
    stated = path / "camera.json"
    if stated.exists():
        return read_calibration(stated, source.width, source.height), []
    focals = [photo.focal_px for photo in photos if photo.focal_px is not None]
    if not focals:
        return camera_of(stated, source, config, start_ns)
    focal = float(np.median(focals))
    spread = float(np.ptp(focals))
    centre = (source.width - 1) / 2, (source.height - 1) / 2
    camera = Camera(source.width, source.height, focal, focal, *centre, assumed=True)
    detail = f"{focal:.0f} px by {photos[0].camera or 'EXIF'}, no distortion"
    warned = [Warned(start_ns, "no camera.json: the focal length is that of EXIF", detail)]
    if spread > 0.01 * focal:
        detail = f"from {min(focals):.0f} to {max(focals):.0f} px; taken: {focal:.0f}"
        warned.append(Warned(start_ns, "the focal length changes on the way", detail))
    return camera, warned


def _places(photos: Sequence[Photo], times_ns: Sequence[int]) -> tuple[LogContent, list[Warned]]:
    collected = TelemetryCollector("EXIF")
    placed = [
        (t_ns, photo) for t_ns, photo in zip(times_ns, photos, strict=True)
        if photo.latitude_deg is not None and photo.longitude_deg is not None
    ]  # fmt: skip
    heights, warnings = _heights(placed, times_ns[0])
    previous: tuple[float, float] | None = None
    n_same = 0
    for (t_ns, photo), height_m in zip(placed, heights, strict=True):
        assert photo.latitude_deg is not None
        assert photo.longitude_deg is not None
        here = photo.latitude_deg, photo.longitude_deg
        if here == previous:  # the receiver had nothing new yet
            n_same += 1
        else:
            collected.add(t_ns, 0, GeodeticFix(PositionSource.GPS, *here, height_m))
        previous = here
    for t_ns, photo in zip(times_ns, photos, strict=True):
        if photo.gimbal_deg is not None:
            turn = quaternion_from_euler(*map(math.radians, photo.gimbal_deg))
            collected.add(t_ns, 0, AttitudeSample(0, turn))
    if n_same:
        detail = f"{n_same} of {len(placed)}"
        warnings.append(Warned(times_ns[0], "places that were not new left out", detail))
    return LogContent(collected, unchanged), warnings


def _heights(
    placed: Sequence[tuple[int, Photo]], start_ns: int
) -> tuple[list[float], list[Warned]]:
    """Barometric heights if given; one height for all where they are implausible."""
    if not placed:
        return [], []
    relative = [photo.relative_altitude_m for _, photo in placed]
    if all(height is not None for height in relative):
        first = placed[0][1]
        base_m = (first.altitude_m or 0.0) - (first.relative_altitude_m or 0.0)
        return [base_m + (height or 0.0) for height in relative], []
    heights = [photo.altitude_m for _, photo in placed]
    known = [height for height in heights if height is not None]
    if len(known) < len(heights):
        middle = float(np.median(known)) if known else 0.0
        what = "heights are missing in EXIF: the flight is taken to be level"
        detail = f"{len(heights) - len(known)} of {len(heights)}; taken: {middle:.1f} m"
        return [middle] * len(heights), [Warned(start_ns, what, detail)]
    t_s = np.array([(t_ns - start_ns) * 1e-9 for t_ns, _ in placed])
    climb = _steady_climb(t_s, np.array(known))
    if climb is None:
        return known, []
    middle = float(np.median(known))
    what = "heights in EXIF are suspect: the flight is taken to be level"
    detail = f"they rise steadily by {climb:.0f} m from begin to end; taken: {middle:.1f} m"
    return [middle] * len(known), [Warned(start_ns, what, detail)]


def _steady_climb(t_s: Array, height_m: Array) -> float | None:
    """Drift of heights from begin to end, if that explains most of them; else None.

    Mapping flights are level; a receiver that has just been switched on drifts.
    """
    if len(t_s) < 10 or np.ptp(height_m) < SUSPECT_CLIMB_M:
        return None
    slope, level = np.polyfit(t_s, height_m, 1)
    left = height_m - (slope * t_s + level)
    share = 1 - float(left.var()) / float(height_m.var())
    return float(slope * np.ptp(t_s)) if share > SUSPECT_SHARE else None
