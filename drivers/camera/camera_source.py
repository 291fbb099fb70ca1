"""Interface of a camera: opens, gives stamped images, and may be lost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from companion.errors import SourceError
from companion.messages import Bytes


class EndOfPictures(SourceError):  # noqa: N818 - an end, not a fault
    """The source has no more images."""


class DriverFault(Exception):  # noqa: N818 - nothing that a camera can do
    """Bug of a driver, found in a process of its own; the text is its traceback."""


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """One image of a camera.

    `monotonic_ns` is CLOCK_MONOTONIC at mid-exposure, as well as the source knows; `grey` (H, W)
    u8; `rgb` (H, W, 3) u8. Both are owned by the receiver: no driver writes to them any more.
    """

    monotonic_ns: int
    grey: Bytes
    rgb: Bytes


class CameraSource(Protocol):
    """One kind of camera; used from one thread."""

    name: str
    """For people: a path, a URL without its password."""
    live: bool
    """True if reopening can help where it gives nothing, or the same image again and again."""
    start_s: float
    """Longest time from opening to the first image."""
    silent_s: float
    """Time without an image, after the first, that means that it is silent."""
    remarks: list[str]
    """Deviations from the request; the reader takes them out."""

    @property
    def n_dropped(self) -> int:
        """Images dropped as damaged or too late."""

    def open(self) -> None:
        """Open. SourceError: not there now. ConfigError: impossible as configured.

        OSError counts as SourceError. Any other exception of it or of `read` is a bug.
        """

    def read(self, timeout_s: float) -> Picture | None:
        """Newest image, None if none came in time; SourceError when the camera is lost."""

    def close(self) -> None:
        """Close, in any state; can be called twice."""
