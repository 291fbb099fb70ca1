"""A recorded flight: a folder with pictures, their times, a calibration and the autopilot's log."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.camera import Camera
from companion.config import CameraConfig, TelemetryConfig
from companion.errors import FlightError
from companion.messages import Frame, Warned
from drivers.ahead import Ahead
from drivers.calibration import assumed_camera, read_calibration
from drivers.frame_source import FrameSource, find_frames
from drivers.frame_times import read_frame_times
from drivers.telemetry_folder import Pictures, read_telemetry
from drivers.telemetry_log import TelemetryLog

FRAMES_AHEAD = 4


ENDS_EARLY = "the video ends early"
"""What a flight with fewer frames than frames.csv lists warns of."""


class Flight:
    """A flight that can be read; `open_flight` makes one."""

    def __init__(
        self,
        path: Path,
        camera: Camera,
        source: FrameSource,
        numbers: list[int],
        times_ns: list[int],
        warnings: tuple[Warned, ...],
        telemetry_config: TelemetryConfig,
    ) -> None:
        self.path = path
        self.camera = camera
        self.warnings = warnings
        """What was found amiss on opening."""
        self._source = source
        self._numbers = numbers
        self._times_ns = times_ns
        self._telemetry_config = telemetry_config
        self._telemetry: TelemetryLog | None = None

    @property
    def n_frames(self) -> int:
        """Frames that have a time and a picture."""
        return len(self._numbers)

    @property
    def numbers(self) -> tuple[int, ...]:
        """Index in frames.csv of each of these frames."""
        return tuple(self._numbers)

    @property
    def times_ns(self) -> tuple[int, ...]:
        """Time of each of these frames."""
        return tuple(self._times_ns)

    @property
    def start_ns(self) -> int:
        """Time of the first frame."""
        return self._times_ns[0]

    @property
    def stop_ns(self) -> int:
        """One nanosecond after the last frame."""
        return self._times_ns[-1] + 1

    def n_frames_between(self, start_ns: int | None = None, stop_ns: int | None = None) -> int:
        """How many frames `frames` has to decode between these times."""
        first, beyond = self._part(start_ns, stop_ns)
        return beyond - first

    def frames(
        self, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Frame | Warned]:
        """Frames with start_ns <= t_ns < stop_ns, decoded a few ahead in another thread.

        `seq` is the index in frames.csv. A picture that cannot be decoded comes as a Warned.
        """
        first, beyond = self._part(start_ns, stop_ns)
        ahead = Ahead(self._decode(first, beyond), FRAMES_AHEAD)
        try:
            yield from ahead
        finally:
            ahead.close()

    def telemetry(self) -> TelemetryLog:
        """Everything that the autopilot logged, on the flight's clock; read once, then kept.

        FlightError where none of it is of the time of the frames.
        """
        if self._telemetry is None:
            pictures = Pictures(
                self._source.path, self.start_ns, self.stop_ns, self._host_from_file_ns
            )
            self._telemetry = read_telemetry(self.path, pictures, self._telemetry_config)
        return self._telemetry

    def _host_from_file_ns(self, file_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Times on the flight's clock of times by the video's own, beyond its ends at its rate."""
        own_ns = np.array(self._source.own_times_ns(), np.int64)[self._numbers]
        inside = np.clip(file_ns, own_ns[0], own_ns[-1])
        after_ns = np.interp(inside - own_ns[0], own_ns - own_ns[0], self._since_start())
        out: NDArray[np.int64] = self.start_ns + after_ns.astype(np.int64) + (file_ns - inside)
        return out

    def _since_start(self) -> NDArray[np.int64]:
        return np.array(self._times_ns, np.int64) - self.start_ns

    def _part(self, start_ns: int | None, stop_ns: int | None) -> tuple[int, int]:
        first = 0 if start_ns is None else bisect_left(self._times_ns, start_ns)
        beyond = self.n_frames if stop_ns is None else bisect_left(self._times_ns, stop_ns)
        return first, max(first, beyond)

    def _decode(self, first: int, beyond: int) -> Iterator[Frame | Warned]:
        if first == beyond:
            return
        wanted = dict(zip(self._numbers[first:beyond], self._times_ns[first:beyond], strict=True))
        for number, rgb in self._source.pictures(self._numbers[first], self._numbers[beyond - 1]):
            if number not in wanted:
                continue
            if rgb is None:
                yield Warned(wanted[number], "a picture could not be decoded", f"number {number}")
                continue
            grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
            yield Frame(number, wanted[number], grey, rgb)


def open_flight(
    path: Path, config: CameraConfig, telemetry_config: TelemetryConfig | None = None
) -> Flight:
    """Open a flight folder and check all of it but the telemetry; FlightError where it is amiss."""
    if not path.exists():
        raise FlightError(f"{path}: there is no such folder")
    if not path.is_dir():
        raise FlightError(f"{path}: not a folder; a flight is a folder with camera.mp4 in it")
    source = find_frames(path)
    numbers, times_ns, warnings = _times(path, source)
    calibration = path / "camera.json"
    if calibration.exists():
        camera = read_calibration(calibration, source.width, source.height)
    elif config.assumed_hfov_deg > 0:
        camera = assumed_camera(source.width, source.height, config.assumed_hfov_deg)
        warnings.append(
            Warned(
                times_ns[0],
                "no camera.json: the camera is assumed",
                f"{config.assumed_hfov_deg:g} degrees wide, no distortion, place on body unknown",
            )
        )
    else:
        raise FlightError(
            f"{path}: no camera.json; give one, or a field of view by camera.assumed_hfov_deg"
        )
    return Flight(
        path, camera, source, numbers, times_ns, tuple(warnings),
        telemetry_config or TelemetryConfig(),
    )  # fmt: skip


def _times(path: Path, source: FrameSource) -> tuple[list[int], list[int], list[Warned]]:
    listed = path / "frames.csv"
    if not listed.exists():
        epoch_ns, epoch = source.epoch()
        times_ns = [epoch_ns + t_ns for t_ns in source.own_times_ns()]
        warned = Warned(
            times_ns[0], "no frames.csv: times are the file's own", f"counted from {epoch}"
        )
        return list(range(len(times_ns))), times_ns, [warned]
    numbers, times_ns, warnings = read_frame_times(listed)
    n_there = bisect_left(numbers, source.n_frames)
    if n_there == 0:
        raise FlightError(
            f"{listed}: its first index is {numbers[0]}, and {source.path.name} has only "
            f"{source.n_frames} frames"
        )
    if n_there < len(numbers):
        detail = f"{source.n_frames} frames, frames.csv goes on to {numbers[-1]}"
        warnings.append(Warned(times_ns[n_there - 1], ENDS_EARLY, detail))
    elif numbers[-1] + 1 < source.n_frames:
        detail = f"{source.n_frames - numbers[-1] - 1} frames at the end have no time"
        warnings.append(Warned(times_ns[-1], "frames.csv ends early", detail))
    return numbers[:n_there], times_ns[:n_there], warnings
