"""Telemetry in the subtitles of DJI videos, beside a video or inside it.

Of the forms that DJI has used these are read: words in brackets (`[latitude: 48.1] [rel_alt: 30.5
abs_alt: 520.1] [gb_pitch: -90.0 …]`), `GPS(lon,lat,n) BAROMETER:30.5`, and `GPS (lon, lat, n), …
H 30.5m`. The gimbal's angles are those of the camera, which counts as the body here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import av
import av.error
import numpy as np
from numpy.typing import NDArray

from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose, quaternion_from_euler
from companion.messages import Warned
from companion.telemetry import AttitudeSample, HeightSample, PositionSource
from drivers.images.calibration_file import FORWARD_UPRIGHT
from drivers.images.exif import FILM_DIAGONAL_MM
from drivers.telemetry.telemetry_log import GeodeticFix, LogContent, TelemetryCollector

Times = NDArray[np.int64]
MAX_BYTES = 200_000_000
MAX_CUE = 4000
SPAN = re.compile(r"(\d{1,3}):(\d\d):(\d\d)[,.](\d{3})\s*-->\s*(\d{1,3}):(\d\d):(\d\d)[,.](\d{3})")
NUMBER = r"\s*:?\s*([-+]?\d{1,9}(?:\.\d{1,12})?)"
WORDS = {
    # one of DJI's programs wrote longtitude for years
    name: re.compile(rf"\b{word}{NUMBER}")
    for name, word in {
        "latitude": "latitude", "longitude": "longt?itude", "above_start": "rel_alt",
        "above_sea": "abs_alt", "altitude": "altitude", "yaw": "gb_yaw", "pitch": "gb_pitch",
        "roll": "gb_roll", "focal": "focal_len", "zoom": "dzoom_ratio", "barometer": "BAROMETER",
        "height": "H(?!\\.)",
    }.items()
}  # fmt: skip
PLACE = re.compile(r"\bGPS\s*\(\s*([-+]?\d+\.\d+)\s*,\s*([-+]?\d+\.\d+)")
SIMPLE_NAMES = ("latitude", "longitude")


@dataclass(frozen=True, slots=True)
class Cue:
    """One subtitle: its time in the video, and the numbers in it by name."""

    t_ns: int
    said: dict[str, float]


def read_srt(video: Path, host_from_file_ns: Callable[[Times], Times]) -> LogContent | None:
    """Telemetry of a video's subtitles; None without any."""
    cues = list(cues_of(video))
    if not any("latitude" in cue.said or "pitch" in cue.said for cue in cues):
        return None
    collected = TelemetryCollector(f"subtitles of {video.name}")
    heights = {name for cue in cues for name in cue.said}
    above_sea = bool(heights & {"above_sea", "altitude"})
    previous: tuple[float, float] | None = None
    for cue in cues:
        said = cue.said
        here = said.get("latitude"), said.get("longitude")
        if here[0] is not None and here[1] is not None and here != previous:
            previous = here[0], here[1]
            height_m = said.get("above_sea", said.get("altitude", _above_start(said) or 0.0))
            collected.add(cue.t_ns, 0, GeodeticFix(PositionSource.GPS, *previous, height_m))
        above_start = _above_start(said)
        if above_start is not None:
            collected.add(cue.t_ns, 0, HeightSample(0, above_start))
        if {"roll", "pitch", "yaw"} <= said.keys():
            angles = (math.radians(said[name]) for name in ("roll", "pitch", "yaw"))
            collected.add(cue.t_ns, 0, AttitudeSample(0, quaternion_from_euler(*angles)))
    warnings = []
    if previous is not None and not above_sea:
        detail = "the subtitles tell no height above the sea"
        warnings.append(Warned(0, "heights count from the take-off", detail))

    def host_ns(remote_ns: Times, segment: Times) -> Times:
        return host_from_file_ns(remote_ns)

    return LogContent(collected, host_ns, None, tuple(warnings))


def srt_camera(video: Path, width: int, height: int) -> tuple[Camera, str] | None:
    """Camera as far as the subtitles give it, and a remark; None where they do not."""
    for cue in cues_of(video):
        film_mm = cue.said.get("focal", 0.0)
        film_mm = film_mm / 10 if film_mm > 100 else film_mm  # some write tenths
        film_mm *= max(cue.said.get("zoom", 1.0), 1.0)
        if film_mm < 5:
            return None
        focal = film_mm / FILM_DIAGONAL_MM * float(np.hypot(width, height))
        mounted = Pose(FORWARD_UPRIGHT, np.zeros(3)) if "pitch" in cue.said else None
        centre = (width - 1) / 2, (height - 1) / 2
        camera = Camera(
            width, height, focal, focal, *centre, body_from_camera=mounted, assumed=True
        )
        return camera, f"{film_mm:.1f} mm on 35 mm film, so {focal:.0f} px, no distortion"
    return None


def cues_of(video: Path) -> Iterator[Cue]:
    """Subtitles with data of a video, in order: beside it, else inside it."""
    beside = _file_beside(video)
    for t_ns, text in _in_file(beside) if beside is not None else _inside(video):
        said = _numbers(text[:MAX_CUE])
        if said:
            yield Cue(t_ns, said)


def _file_beside(video: Path) -> Path | None:
    for suffix in (".SRT", ".srt"):
        if video.with_suffix(suffix).is_file():
            return video.with_suffix(suffix)
    return None


def _in_file(path: Path) -> Iterator[tuple[int, str]]:
    try:
        if path.stat().st_size > MAX_BYTES:
            return
        text = path.read_text("utf-8", "replace")
    except OSError:
        return
    spans = list(SPAN.finditer(text))
    ends = [span.start() for span in spans[1:]] + [len(text)]
    latest_ns = -1
    for span, end in zip(spans, ends, strict=False):
        hours, minutes, seconds, ms = (int(part) for part in span.groups()[:4])
        t_ns = ((hours * 60 + minutes) * 60 + seconds) * 1_000_000_000 + ms * 1_000_000
        if t_ns > latest_ns:
            latest_ns = t_ns
            yield t_ns, text[span.end() : end]


def _inside(video: Path) -> Iterator[tuple[int, str]]:
    try:
        with av.open(str(video)) as container:
            if not container.streams.subtitles:
                return
            stream = container.streams.subtitles[0]
            if stream.time_base is None:
                return
            for packet in container.demux(stream):
                if packet.pts is not None and packet.size:
                    t_ns = round(packet.pts * stream.time_base * 1_000_000_000)
                    yield t_ns, bytes(packet)[:MAX_CUE].decode("utf-8", "replace")
    except (av.error.FFmpegError, ValueError):
        return  # the video is cut short: the part before counts


def _numbers(text: str) -> dict[str, float]:
    said = {}
    for name, pattern in WORDS.items():
        found = pattern.search(text)
        if found is not None:
            said[name] = float(found[1])
    place = PLACE.search(text)
    if place is not None:
        said["longitude"], said["latitude"] = float(place[1]), float(place[2])
    elif "height" in said and not said.keys() & {"latitude", "barometer"}:
        del said["height"]
    # zeros are what is written before there is a fix
    if (
        abs(said.get("latitude", 0.0)) > 90
        or abs(said.get("longitude", 0.0)) > 180
        or not (said.get("latitude") or said.get("longitude"))
    ):
        for name in SIMPLE_NAMES:
            said.pop(name, None)
    return said


def _above_start(said: dict[str, float]) -> float | None:
    return next((said[n] for n in ("above_start", "barometer", "height") if n in said), None)
