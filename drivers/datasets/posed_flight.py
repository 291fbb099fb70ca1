"""Folders of images with poses but without times (REMODE, deep-video-mvs), as a flight.

Their poses are ground truth: the images get times of a nominal rate.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from companion.config import CameraConfig, TelemetryConfig
from companion.errors import FlightError
from companion.messages import Bytes, Warned
from drivers.datasets.posed_images import PosedImages
from drivers.datasets.posed_layouts import open_posed_images
from drivers.flight import Flight, TruePose
from drivers.telemetry.telemetry_log import no_telemetry

STEP_NS = 100_000_000


def is_posed_folder(path: Path) -> bool:
    """True if a folder has one of the layouts of images with poses."""
    posed_video = (path / "K.txt").is_file() and (path / "poses.txt").is_file()
    return posed_video or any(path.glob("*input_sequence*.txt"))


def open_posed_flight(path: Path, config: CameraConfig, telemetry: TelemetryConfig) -> Flight:
    """Open such a folder; FlightError where it is incomplete."""
    images = open_posed_images(path)
    times_ns = [number * STEP_NS for number in range(len(images))]
    warned = Warned(times_ns[0], "no times: images are taken to come at 10/s", images.layout)
    truth = [
        TruePose(t_ns, pose)
        for t_ns, pose in zip(times_ns, images.poses, strict=True)
        if pose is not None
    ]
    return Flight(
        path, images.camera, PosedPictures(images), list(range(len(images))), times_ns, [warned],
        no_telemetry, lambda: truth,
    )  # fmt: skip


class PosedPictures:
    """Images of such a folder; see `FrameSource`."""

    def __init__(self, images: PosedImages) -> None:
        self.path = images.path
        self.width, self.height = images.camera.width, images.camera.height
        self._images = images

    @property
    def n_frames(self) -> int:
        """Number of images in the folder's list."""
        return len(self._images)

    def own_times_ns(self) -> list[int]:
        """Ten images a second."""
        return [number * STEP_NS for number in range(self.n_frames)]

    def pictures(self, first: int, last: int) -> Iterator[tuple[int, Bytes | None]]:
        """Number and RGB image of images first..last; None for a damaged or odd-sized one."""
        for number in range(first, last + 1):
            try:
                yield from self._images.pictures([number])
            except FlightError:
                yield number, None
