"""Metadata of a still image: time, position and lens (EXIF, and DJI's XMP)."""

from __future__ import annotations

import re
import struct
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image, UnidentifiedImageError

DAMAGE = (
    UnidentifiedImageError, OSError, SyntaxError, ValueError, TypeError, KeyError, IndexError,
    ArithmeticError, AttributeError, EOFError, MemoryError, RuntimeError, struct.error,
)  # fmt: skip
"""Exceptions of Pillow on damaged files."""
FILM_DIAGONAL_MM = 43.2666
MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
XMP_NUMBER = re.compile(
    r"drone-dji:(RelativeAltitude|Gimbal(?:Yaw|Pitch|Roll)Degree)\s*(?:=\s*\"|>)\s*([-+0-9.]+)"
)
MAX_XMP = 1_000_000


@dataclass(frozen=True, slots=True)
class Photo:
    """Metadata of one still; unknown values are None.

    `local_ns` is by the camera's clock, of unknown zone, `utc_ns` by satellites, both whole
    seconds; `subsecond_ns` belongs to the first. `focal_px` is for the image size as it is.
    `gimbal_deg` is roll, pitch and yaw of the camera, where a pitch of 0 looks at the horizon.
    """

    path: Path
    width: int
    height: int
    local_ns: int | None = None
    subsecond_ns: int | None = None
    utc_ns: int | None = None
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_m: float | None = None
    focal_px: float | None = None
    camera: str = ""
    relative_altitude_m: float | None = None
    gimbal_deg: tuple[float, float, float] | None = None


def read_photo(path: Path) -> Photo | None:
    """Metadata of a still; None where the file is no image."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of damage in parts that are not looked at
            with Image.open(path) as image:
                return _photo(path, image)
    except DAMAGE:
        return None


def _photo(path: Path, image: Image.Image) -> Photo:
    exif = image.getexif()
    of_shot: Mapping[int, Any] = exif.get_ifd(ExifTags.IFD.Exif)
    of_place: Mapping[int, Any] = exif.get_ifd(ExifTags.IFD.GPSInfo)
    base, gps = ExifTags.Base, ExifTags.GPS
    height_m = _number(of_place.get(gps.GPSAltitude))
    below = of_place.get(gps.GPSAltitudeRef) in (1, b"\x01")
    xmp = _xmp(image)
    angles = [xmp.get(f"Gimbal{axis}Degree") for axis in ("Roll", "Pitch", "Yaw")]
    roll, pitch, yaw = angles
    return Photo(
        path, *image.size,
        local_ns=_time(of_shot.get(base.DateTimeOriginal)),
        subsecond_ns=_subsecond(of_shot.get(base.SubsecTimeOriginal)),
        utc_ns=_utc(of_place.get(gps.GPSDateStamp), of_place.get(gps.GPSTimeStamp)),
        latitude_deg=_degrees(of_place, gps.GPSLatitude, gps.GPSLatitudeRef, "S", 90.0),
        longitude_deg=_degrees(of_place, gps.GPSLongitude, gps.GPSLongitudeRef, "W", 180.0),
        altitude_m=None if height_m is None else -height_m if below else height_m,
        focal_px=_focal_px(of_shot, *image.size),
        camera=_camera(*(str(exif.get(tag, "")).strip("\0 ") for tag in (base.Make, base.Model))),
        relative_altitude_m=xmp.get("RelativeAltitude"),
        gimbal_deg=None if roll is None or pitch is None or yaw is None else (roll, pitch, yaw),
    )  # fmt: skip


def _camera(make: str, model: str) -> str:
    """Make and model, unless the model contains the make."""
    return model if model.startswith(make) else f"{make} {model}".strip()


def _xmp(image: Image.Image) -> dict[str, float]:
    raw = image.info.get("xmp", b"")
    text = raw[:MAX_XMP].decode("utf-8", "replace") if isinstance(raw, bytes) else str(raw)
    found = {}
    for name, value in XMP_NUMBER.findall(text):
        try:
            found[name] = float(value)
        except ValueError:
            continue
    return found


def _focal_px(shot: Mapping[int, Any], width: int, height: int) -> float | None:
    """Focal length by the sensor's pixel pitch if given, else by its 35 mm equivalent."""
    base = ExifTags.Base
    focal_mm = _number(shot.get(base.FocalLength))
    per_unit = _number(shot.get(base.FocalPlaneXResolution))
    unit_mm = MM_PER_UNIT.get(int(_number(shot.get(base.FocalPlaneResolutionUnit)) or 2))
    taken_px = _number(shot.get(base.ExifImageWidth)) or width
    found = 0.0
    if focal_mm and per_unit and unit_mm:
        # the picture may have been made smaller since: what counts is the width of the sensor
        found = focal_mm / (taken_px / per_unit * unit_mm) * width
    else:
        film_mm = _number(shot.get(base.FocalLengthIn35mmFilm))
        if film_mm:
            found = film_mm / FILM_DIAGONAL_MM * float(np.hypot(width, height))
    return found if 0.2 * width < found < 50 * width else None


def _degrees(
    place: Mapping[int, Any], tag: int, reference: int, negative: str, most: float
) -> float | None:
    parts = place.get(tag)
    if not isinstance(parts, (tuple, list)) or len(parts) != 3:
        return None
    numbers = [_number(part) for part in parts]
    if any(number is None for number in numbers):
        return None
    value = sum((n or 0.0) / unit for n, unit in zip(numbers, (1, 60, 3600), strict=True))
    value = -value if str(place.get(reference, "")).strip("\0 ").upper() == negative else value
    return value if abs(value) <= most else None


def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if np.isfinite(number) else None


def _time(text: Any) -> int | None:
    """Time of text such as `2014:10:19 13:20:51`, as if it were UTC, ns."""
    words = str(text).strip("\0 ").split()
    if len(words) != 2:
        return None
    try:
        stamp = np.datetime64(f"{words[0].replace(':', '-')}T{words[1]}", "s")
    except ValueError:
        return None
    seconds = int(stamp.astype(np.int64))
    return seconds * 1_000_000_000 if 0 < seconds < 9e9 else None


def _subsecond(text: Any) -> int | None:
    digits = str(text).strip("\0 ")
    if not (digits.isascii() and digits.isdigit()):
        return None
    return int(digits[:9].ljust(9, "0"))


def _utc(date: Any, time: Any) -> int | None:
    numbers = [_number(v) for v in time] if isinstance(time, (tuple, list)) else []
    if len(numbers) != 3 or any(n is None or not 0 <= n < 61 for n in numbers):
        return None
    hours, minutes, seconds = (n or 0.0 for n in numbers)
    midnight = _time(f"{str(date).strip(chr(0) + ' ')} 00:00:00")
    if midnight is None:
        return None
    return midnight + round((hours * 3600 + minutes * 60 + seconds) * 1e9)
