"""A recorded flight of any format: frames in order of time, and telemetry."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose
from companion.messages import Frame, Warned
from drivers.images.frame_source import FrameSource
from drivers.images.prefetch import Prefetch
from drivers.telemetry.telemetry_log import Pictures, TelemetryLog

PREFETCHED = 4
ENDS_EARLY = "the video ends early"
"""Warning about fewer frames than the list of times has."""


class TruePose(NamedTuple):
    """Ground truth of a frame: `world_from_camera` in metres, in a world of the format's."""

    t_ns: int
    world_from_camera: Pose


class Flight:
    """A readable flight; created by `open_flight`."""

    def __init__(
        self,
        path: Path,
        camera: Camera,
        source: FrameSource,
        numbers: list[int],
        times_ns: list[int],
        warnings: Sequence[Warned],
        read_log: Callable[[Pictures], TelemetryLog],
        read_truth: Callable[[], Sequence[TruePose]] = tuple,
    ) -> None:
        self.path = path
        self.camera = camera
        self.warnings = tuple(warnings)
        """Warnings on opening."""
        self.source = source
        """Source of its images."""
        self._numbers = numbers
        self._times_ns = times_ns
        self._read_log = read_log
        self._read_truth = read_truth
        self._telemetry: TelemetryLog | None = None

    @property
    def n_frames(self) -> int:
        """Number of frames that have a time and an image."""
        return len(self._numbers)

    @property
    def numbers(self) -> tuple[int, ...]:
        """Number of each of these frames in its source."""
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
        """Number of frames that `frames` has to decode between these times."""
        first, beyond = self._part(start_ns, stop_ns)
        return beyond - first

    def frames(
        self, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Frame | Warned]:
        """Frames with start_ns <= t_ns < stop_ns, prefetched in another thread.

        `seq` is the number in the source. An image that cannot be decoded comes as a Warned.
        """
        first, beyond = self._part(start_ns, stop_ns)
        prefetch = Prefetch(self._decode(first, beyond), PREFETCHED)
        try:
            yield from prefetch
        finally:
            prefetch.close()

    def telemetry(self) -> TelemetryLog:
        """All telemetry, on the flight's clock; read once, then kept.

        FlightError where none of it overlaps the time of the frames.
        """
        if self._telemetry is None:
            pictures = Pictures(
                self.source.path, self.start_ns, self.stop_ns, self._host_from_file_ns
            )
            self._telemetry = self._read_log(pictures)
        return self._telemetry

    def truth(self) -> Sequence[TruePose]:
        """Ground truth of the frames, where the format has it; for scoring only."""
        return self._read_truth()

    def _host_from_file_ns(self, file_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Times on the flight's clock of times of the video, extrapolated at its ends."""
        own_ns = np.array(self.source.own_times_ns(), np.int64)[self._numbers]
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
        for number, rgb in self.source.pictures(self._numbers[first], self._numbers[beyond - 1]):
            if number not in wanted:
                continue
            if rgb is None:
                yield Warned(wanted[number], "a picture could not be decoded", f"number {number}")
                continue
            grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
            yield Frame(number, wanted[number], grey, rgb)
