"""A recorded flight, a folder of images or a video as a camera, in real time."""

from __future__ import annotations

import time
from bisect import bisect_left
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from companion.config import CameraConfig
from companion.errors import ConfigError, FlightError, SourceError
from companion.messages import Bytes
from drivers.camera.camera_source import EndOfPictures, Picture
from drivers.images.frame_source import VIDEO_SUFFIXES, FrameSource, Video, find_frames
from drivers.images.frame_times import read_frame_times
from drivers.images.prefetch import Prefetch

PREFETCHED = 3


class FileCamera:
    """Gives each image when it is due; skips those whose successor is due already."""

    live = False
    start_s = 5.0
    silent_s = 1.0

    def __init__(self, config: CameraConfig) -> None:
        self._path = Path(config.path)
        self._repeat = config.repeat
        self._starts_ns = round(config.starts_at_unix_s * 1e9)
        self.name = config.path
        self.n_dropped = 0
        self.remarks: list[str] = []
        self._numbers: list[int] = []
        self._after_ns: list[int] = []
        self._source: FrameSource | None = None
        self._prefetch: Prefetch[tuple[int, Bytes | None]] | None = None
        self._pictures: Iterator[tuple[int, Bytes | None]] = iter(())
        self._begun_ns = 0
        self._waiting: tuple[int, Bytes] | None = None

    def open(self) -> None:
        """Find the images and their times, and start to decode; see `CameraSource`."""
        self.close()
        try:
            self._source = _frames(self._path)
            self._numbers, times_ns = _times(self._path, self._source)
        except FlightError as error:
            raise ConfigError(f"camera.path: {error}") from error
        self._after_ns = [t_ns - times_ns[0] for t_ns in times_ns]
        self._begun_ns = time.monotonic_ns()
        if self._starts_ns:
            self._begun_ns += self._starts_ns - time.time_ns()
        self._begin()

    def read(self, timeout_s: float) -> Picture | None:
        """The next picture, once it is due; see `CameraSource`."""
        deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        if self._waiting is None:
            self._waiting = self._next()
        due_ns, rgb = self._waiting
        wait_ns = min(due_ns, deadline_ns) - time.monotonic_ns()
        if wait_ns > 0:
            time.sleep(wait_ns * 1e-9)
        if due_ns > time.monotonic_ns():
            return None
        self._waiting = None
        grey = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)
        return Picture(due_ns, grey, rgb)

    def close(self) -> None:
        """Stop decoding."""
        prefetch, self._prefetch = self._prefetch, None
        if prefetch is not None:
            prefetch.close()
        self._pictures, self._waiting = iter(()), None

    def _begin(self) -> None:
        assert self._source is not None
        self._prefetch = Prefetch(
            self._source.pictures(self._numbers[0], self._numbers[-1]), PREFETCHED
        )
        self._pictures = iter(self._prefetch)

    def _next(self) -> tuple[int, Bytes]:
        """Next image that is not too late, and when it is due by CLOCK_MONOTONIC."""
        if self._prefetch is None:
            raise SourceError(f"{self.name}: not open")
        while True:
            for number, rgb in self._pictures:
                at = bisect_left(self._numbers, number)
                if at == len(self._numbers) or self._numbers[at] != number:
                    continue
                is_last = at + 1 == len(self._numbers)
                next_ns = self._begun_ns + self._after_ns[at if is_last else at + 1]
                late = not is_last and next_ns < time.monotonic_ns()
                if rgb is None or late:
                    self.n_dropped += 1
                    continue
                return self._begun_ns + self._after_ns[at], rgb
            if not self._repeat:
                raise EndOfPictures(f"{self.name}: all {len(self._numbers)} pictures were shown")
            self._prefetch.close()
            mean_ns = self._after_ns[-1] // max(1, len(self._after_ns) - 1)
            # a machine that cannot keep up does not begin in the past
            self._begun_ns = max(self._begun_ns + self._after_ns[-1] + mean_ns, time.monotonic_ns())
            self._begin()


def _frames(path: Path) -> FrameSource:
    if path.is_dir():
        return find_frames(path)
    if path.suffix.lower() in VIDEO_SUFFIXES and path.exists():
        return Video(path)
    raise FlightError(f"{path}: neither a folder nor a video that exists")


def _times(path: Path, source: FrameSource) -> tuple[list[int], list[int]]:
    listed = path / "frames.csv"
    if not listed.exists():
        return list(range(source.n_frames)), source.own_times_ns()
    numbers, times_ns, _ = read_frame_times(listed)
    n_there = bisect_left(numbers, source.n_frames)
    if n_there == 0:
        raise FlightError(f"{listed}: there are no pictures with the numbers that it lists")
    return numbers[:n_there], times_ns[:n_there]
