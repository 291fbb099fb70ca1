"""Synthetic stills with EXIF, as cameras on drones write them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from PIL import ExifTags, Image

from tests.support.flights.logs import picture

Base, Gps = ExifTags.Base, ExifTags.GPS


def sexagesimal(degrees: float) -> tuple[float, float, float]:
    whole = abs(degrees)
    minutes = whole % 1 * 60
    return float(int(whole)), float(int(minutes)), round(minutes % 1 * 60, 5)


def write_photo(
    path: Path, number: int, *, local: str | None = None, subsecond: str | None = None,
    utc: tuple[str, tuple[float, float, float]] | None = None,
    place: tuple[float, float, float | None] | None = None,
    shot: dict[int, Any] | None = None, xmp: str | None = None, model: str = "Model",
) -> None:  # fmt: skip
    """A picture whose brightness tells its number; `place` is latitude, longitude, height."""
    exif = Image.Exif()
    exif[Base.Make], exif[Base.Model] = "Maker", model
    inside = exif.get_ifd(ExifTags.IFD.Exif)
    inside.update(shot or {})
    if local is not None:
        inside[Base.DateTimeOriginal] = local
    if subsecond is not None:
        inside[Base.SubsecTimeOriginal] = subsecond
    gps = exif.get_ifd(ExifTags.IFD.GPSInfo)
    if place is not None:
        latitude, longitude, height = place
        gps[Gps.GPSLatitudeRef], gps[Gps.GPSLatitude] = "NS"[latitude < 0], sexagesimal(latitude)
        gps[Gps.GPSLongitudeRef] = "EW"[longitude < 0]
        gps[Gps.GPSLongitude] = sexagesimal(longitude)
        if height is not None:
            gps[Gps.GPSAltitudeRef], gps[Gps.GPSAltitude] = bytes([height < 0]), abs(height)
    if utc is not None:
        gps[Gps.GPSDateStamp], gps[Gps.GPSTimeStamp] = utc
    options: dict[str, Any] = {"xmp": xmp.encode()} if xmp is not None else {}
    Image.fromarray(picture(number)).save(path, "JPEG", quality=95, exif=exif, **options)
