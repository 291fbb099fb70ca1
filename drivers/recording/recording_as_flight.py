"""A recording as a flight: its frames and samples, with their recorded times."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from companion.config import CameraConfig, TelemetryConfig
from companion.errors import FlightError
from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.messages import Bytes, ClockReport, Frame, Warned
from drivers.flight import Flight
from drivers.images.calibration_file import assumed_camera
from drivers.images.camera_document import camera_of
from drivers.recording.flights_folder import RECORDING
from drivers.recording.mcap_file import McapFile
from drivers.recording.picture_codec import grey_of, still
from drivers.recording.recorder import CAMERA_JSON
from drivers.recording.recording_reader import PicturePlace, RecordingReader, with_pictures
from drivers.recording.recording_topics import PROFILE, VIDEO
from drivers.recording.video_codec import VideoDecoder
from drivers.telemetry.telemetry_log import TelemetryLog, rates_hz

NO_TELEMETRY = "no telemetry"
LOST = "a picture could not be decoded"


class RecordedPictures:
    """Images of a recording as a `FrameSource`; their numbers are those of the flight."""

    def __init__(self, recording: RecordingReader, camera: Camera) -> None:
        self.path = recording.path
        self.width, self.height = camera.width, camera.height
        self.recording = recording

    @property
    def n_frames(self) -> int:
        """Number of images."""
        return len(self.recording.pictures)

    def own_times_ns(self) -> list[int]:
        """Times of the flight."""
        return [place.t_ns for place in self.recording.pictures]

    def pictures(self, first: int, last: int) -> Iterator[tuple[int, Bytes | None]]:
        """Number and RGB image of images first..last; None where one cannot be decoded."""
        places = [p for p in self.recording.pictures if first <= p.seq <= last]
        for place, rgb in self.decoded(places):
            right = rgb is not None and rgb.shape == (self.height, self.width, 3)
            yield place.seq, rgb if right else None

    def decoded(self, places: list[PicturePlace]) -> Iterator[tuple[PicturePlace, Bytes | None]]:
        """Consecutive images; None where one cannot be decoded."""
        if not places:
            return
        if self.recording.picture_data(places[0])[0] != VIDEO:
            for place in places:
                yield place, still(*self.recording.picture_data(place))
            return
        every = self.recording.pictures
        first = every.index(places[0])
        begin = max((k for k in range(first + 1) if every[k].intra), default=first)
        run = every[begin : first + len(places)]
        wanted = set(places)
        for number, rgb in VideoDecoder().pictures(self._packets(run)):
            if run[number] in wanted:
                yield run[number], rgb

    def _packets(self, run: list[PicturePlace]) -> Iterator[tuple[int, bytes, bool]]:
        before = run[0].chunk
        for number, place in enumerate(run):
            lost = any(map(self.recording.lost_before, range(before + 1, place.chunk + 1)))
            before = place.chunk
            yield number, self.recording.picture_data(place)[1], lost


class RecordedFlight(Flight):
    """A flight read from our own recording."""

    def __init__(self, recording: RecordingReader, camera: Camera, log: TelemetryLog) -> None:
        places = recording.pictures
        super().__init__(
            recording.path, camera, RecordedPictures(recording, camera),
            [place.seq for place in places], [place.t_ns for place in places],
            recording.warnings, lambda _: log,
        )  # fmt: skip
        self.recording = recording

    def _decode(self, first: int, beyond: int) -> Iterator[Frame | Warned]:
        places = self.recording.pictures[first:beyond]
        source = RecordedPictures(self.recording, self.camera)
        shape = self.camera.height, self.camera.width
        for place, rgb in source.decoded(places):
            if rgb is None or rgb.shape != (*shape, 3):
                yield Warned(place.t_ns, LOST, f"number {place.seq}")
                continue
            grey = self.recording.grey(place.t_ns)
            fits = grey is not None and grey.shape == shape
            yield Frame(place.seq, place.t_ns, grey if fits and grey is not None else grey_of(rgb),
                        rgb)  # fmt: skip


def is_recording(path: Path) -> bool:
    """True if a file is a recording of this program, whole or not."""
    try:
        with McapFile(path) as file:
            return file.profile() == PROFILE
    except FlightError:
        return False


def open_recording(path: Path, config: CameraConfig, telemetry: TelemetryConfig) -> RecordedFlight:
    """Open a recording, repaired if needed; FlightError where there is no flight in it."""
    recording = with_pictures(path)
    start_ns = recording.pictures[0].t_ns
    camera, missing = _camera(recording, config, start_ns)
    return RecordedFlight(recording, camera, telemetry_of(recording, telemetry, missing))


def is_recorded_folder(path: Path) -> bool:
    """True if a folder is that of a recorded live flight."""
    return (path / RECORDING).is_file()


def open_recorded_folder(
    path: Path, config: CameraConfig, telemetry: TelemetryConfig
) -> RecordedFlight:
    """Open the recording in the folder of a live flight; see `open_recording`."""
    return open_recording(path / RECORDING, config, telemetry)


def clock_of(health: dict[str, Any]) -> ClockReport | None:
    """Clock report in a health document."""
    given = health.get("clock")
    if not isinstance(given, dict):
        return None
    try:
        return ClockReport(
            str(given["method"]), float(given["offset_s"]), float(given["drift_ppm"]),
            float(given["sigma_ms"]), int(given["n_reboots"]),
        )  # fmt: skip
    except (KeyError, TypeError, ValueError):
        return None


def origin_of(health: dict[str, Any]) -> GeoOrigin | None:
    """Geodetic origin of local NED in a health document."""
    given = health.get("origin")
    if not isinstance(given, dict):
        return None
    try:
        values = [float(given[f.name]) for f in dataclasses.fields(GeoOrigin)]
    except (KeyError, TypeError, ValueError):
        return None
    return GeoOrigin(*values) if all(map(math.isfinite, values)) else None


def warnings_of(health: dict[str, Any]) -> tuple[Warned, ...]:
    """Warnings of an import's source, in a health document."""
    given = health.get("warnings")
    out = []
    for each in given if isinstance(given, list) else ():
        try:
            out.append(Warned(int(each["t_ns"]), str(each["what"]), str(each["detail"])))
        except (KeyError, TypeError, ValueError, OverflowError):
            continue
    return tuple(out)


def _camera(
    recording: RecordingReader, config: CameraConfig, start_ns: int
) -> tuple[Camera, tuple[Warned, ...]]:
    try:
        return camera_of(recording.found.attachments[CAMERA_JSON]), ()
    except (KeyError, ValueError):
        pass
    source = recording.pictures[0]
    topic, data = recording.picture_data(source)
    rgb = still(topic, data) if topic != VIDEO else None
    if topic == VIDEO:
        rgb = next((p for _, p in VideoDecoder().pictures([(0, data, False)])), None)
    if rgb is None or not config.assumed_hfov_deg:
        raise FlightError(f"{recording.path}: its camera.json is damaged")
    height, width = rgb.shape[:2]
    detail = f"{config.assumed_hfov_deg:g} degrees wide, no distortion, place on body unknown"
    warned = Warned(start_ns, "the camera's calibration is damaged: it is assumed", detail)
    return assumed_camera(width, height, config.assumed_hfov_deg), (warned,)


def telemetry_of(
    recording: RecordingReader, config: TelemetryConfig, warnings: tuple[Warned, ...] = ()
) -> TelemetryLog:
    """Samples of a recording, with these warnings and its own; it must have images."""
    shift_ns = round(config.offset_s * 1e9)
    samples = recording.samples
    if shift_ns:
        samples = [dataclasses.replace(each, t_ns=each.t_ns + shift_ns) for each in samples]
    health = recording.health
    warnings = (*warnings, *warnings_of(health))
    if not samples and all(warned.what != NO_TELEMETRY for warned in warnings):
        start_ns = recording.pictures[0].t_ns
        missing = Warned(start_ns, NO_TELEMETRY, "neither scale nor level will be known")
        warnings = (*warnings, missing)
    return TelemetryLog(
        recording.path.name, samples, clock_of(health), origin_of(health), warnings,
        rates_hz(samples),
    )  # fmt: skip
