"""Source of a flight's images: a video or a folder of numbered images, decoded one by one.

An image keeps its number in the file, whatever becomes of its neighbours: one that cannot be
decoded leaves a gap and shifts nothing.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol

import av
import av.error
import cv2
import numpy as np

from companion.errors import FlightError
from companion.messages import Bytes
from drivers.images.picture_file import read_picture

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".mkv", ".avi", ".m4v", ".webm"})
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"})


class FrameSource(Protocol):
    """Images by number; one that cannot be decoded comes as None."""

    path: Path
    width: int
    height: int

    @property
    def n_frames(self) -> int:
        """Number of images."""

    def own_times_ns(self) -> list[int]:
        """Times of the images in their file, which begin about zero."""

    def pictures(self, first: int, last: int) -> Iterator[tuple[int, Bytes | None]]:
        """Number and RGB image (H, W, 3) of images first..last, both included."""


def find_frames(folder: Path) -> Video | ImageFolder:
    """The video or the images of a flight folder; FlightError unless there is one set."""
    videos = sorted(p for p in folder.iterdir() if p.suffix.lower() in VIDEO_SUFFIXES)
    named = [p for p in videos if p.stem == "camera"]
    if len(videos) > 1 and len(named) != 1:
        names = ", ".join(p.name for p in videos)
        raise FlightError(f"{folder}: several videos ({names}); name the one to read camera.mp4")
    if videos:
        return Video(named[0] if named else videos[0])
    for place in (folder / "images", folder):
        if place.is_dir():
            images = [p for p in place.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES]
            if images:
                return ImageFolder(place, sorted(images, key=_natural))
    raise FlightError(f"{folder}: no video and no images; wanted is camera.mp4 or a folder images/")


def _natural(path: Path) -> list[tuple[bool, int, str]]:
    parts = re.split(r"(\d+)", path.name)
    return [(part.isdigit(), int(part) if part.isdigit() else 0, part) for part in parts]


class Video:
    """Video file; its images are numbered in presentation order."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with av.open(str(path)) as container:
                if not container.streams.video:
                    raise FlightError(f"{path}: there is no video stream in it")
                stream = container.streams.video[0]
                self.width, self.height = stream.width, stream.height
                self._time_base = stream.time_base
                created = container.metadata.get("creation_time")
                self._pts = _stamps_of_packets(container, stream)
        except (av.error.FFmpegError, ValueError) as error:
            raise FlightError(f"{path}: not a video that can be read: {_reason(error)}") from error
        self._created_ns = _unix_ns(created)
        if not self._pts or not self.width or not self._time_base:
            raise FlightError(f"{path}: there are no frames in it")
        self._number_of = {pts: number for number, pts in enumerate(self._pts)}

    @property
    def n_frames(self) -> int:
        """Number of images in the file, decodable or not."""
        return len(self._pts)

    def own_times_ns(self) -> list[int]:
        """Presentation times."""
        assert self._time_base is not None
        unit_ns = self._time_base * 1_000_000_000
        return [round(pts * unit_ns) for pts in self._pts]

    def epoch(self) -> tuple[int, str]:
        """Unix time in ns of zero of these, as far as the file knows, and its source in words."""
        return self._created_ns, "the file's time of creation" if self._created_ns else "zero"

    def pictures(self, first: int, last: int) -> Iterator[tuple[int, Bytes | None]]:
        """Number and RGB image of images first..last; None where one cannot be decoded."""
        expected = first
        with av.open(str(self.path)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "SLICE"  # frame threads would smear errors over neighbours
            if first > 0:
                container.seek(self._pts[first], stream=stream, backward=True)
            for frame in _decoded(container, stream):
                stamp = frame.pts if frame.pts is not None else frame.dts
                number = self._number_of.get(stamp) if stamp is not None else None
                if number is None or number < expected:
                    continue
                while expected < min(number, last + 1):
                    yield expected, None
                    expected += 1
                if number > last:
                    return
                right = (frame.width, frame.height) == (self.width, self.height)
                usable = right and not frame.is_corrupt
                rgb = np.asarray(frame.to_ndarray(format="rgb24"), np.uint8) if usable else None
                yield number, rgb
                expected = number + 1
        for number in range(expected, last + 1):
            yield number, None


def _decoded(
    container: av.container.InputContainer, stream: av.VideoStream
) -> Iterator[av.VideoFrame]:
    packets = container.demux(stream)
    packet: av.Packet[av.VideoStream] | None
    while True:
        try:
            packet = next(packets, None)
        except av.error.FFmpegError:
            packet = None  # the file ends here, however long it says it is
        try:
            frames = stream.codec_context.decode(packet)
        except av.error.FFmpegError:
            frames = []  # its picture stays missing, which the numbers show
        yield from frames
        if packet is None or not packet.size:  # the decoder has given what it held back
            return


def _stamps_of_packets(container: av.container.InputContainer, stream: av.VideoStream) -> list[int]:
    stamps = []
    try:
        for packet in container.demux(stream):
            stamp = packet.pts if packet.pts is not None else packet.dts
            if stamp is not None and not packet.is_discard:
                stamps.append(stamp)
    except av.error.FFmpegError:
        pass  # cut short: the images so far count
    return sorted(set(stamps))


def _unix_ns(created: str | None) -> int:
    if not created:
        return 0
    try:
        return int(np.datetime64(created.rstrip("Z"), "ns").astype(np.int64))
    except ValueError:
        return 0


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)


class ImageFolder:
    """Numbered images, one file each."""

    def __init__(self, path: Path, files: Sequence[Path]) -> None:
        self.path = path
        self._files = files
        first = next((image for image in map(_load, files) if image is not None), None)
        if first is None:
            raise FlightError(f"{path}: none of its {len(files)} images can be read")
        self.height, self.width = first.shape[:2]

    @property
    def n_frames(self) -> int:
        """Number of image files."""
        return len(self._files)

    def file(self, number: int) -> Path:
        """Path of image `number`, if it exists."""
        return self._files[number]

    def own_times_ns(self) -> list[int]:
        """Times of a nominal rate of ten images a second: image files have none."""
        return [number * 100_000_000 for number in range(self.n_frames)]

    def epoch(self) -> tuple[int, str]:
        """Zero."""
        return 0, "zero, at 10 images/s"

    def pictures(self, first: int, last: int) -> Iterator[tuple[int, Bytes | None]]:
        """Number and RGB image of images first..last; None for a damaged or odd-sized one."""
        for number in range(first, last + 1):
            image = _load(self._files[number])
            right = image is not None and image.shape[:2] == (self.height, self.width)
            yield number, image if right else None


def _load(path: Path) -> Bytes | None:
    bgr = read_picture(path, cv2.IMREAD_COLOR)
    return None if bgr is None else np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
