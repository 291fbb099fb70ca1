"""What a camera is to the rest: something that opens, gives stamped pictures, and may go away."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from companion.errors import SourceError
from companion.messages import Bytes


class EndOfPictures(SourceError):  # noqa: N818 - an end, not a fault
    """The source has shown all that there is; it will show no more."""


class DriverFault(Exception):  # noqa: N818 - nothing that a camera can do
    """A bug of a driver, found by a process of its own; the text is the traceback from there."""


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """One picture of a camera, as it came.

    `monotonic_ns` is CLOCK_MONOTONIC at mid-exposure, as well as the source knows; `grey` (H, W)
    u8; `rgb` (H, W, 3) u8. Both are the receiver's own: no driver writes to them any more.
    """

    monotonic_ns: int
    grey: Bytes
    rgb: Bytes


class CameraSource(Protocol):
    """One kind of camera; used from one thread."""

    name: str
    """For people: a path, a URL without its password."""
    live: bool
    """Whether opening it anew can help where it gives nothing, or one picture for ever."""
    start_s: float
    """The first picture may take so long after opening."""
    silent_s: float
    """No picture for so long, once there were some, means that it is silent."""
    n_dropped: int
    """Pictures that came, and were damaged or too late to be handed on."""
    remarks: list[str]
    """What it does otherwise than asked; the reader takes them out."""

    def open(self) -> None:
        """Begin. SourceError: it is not there now. ConfigError: as configured it never will be.

        OSError is taken for a SourceError. Whatever else it or `read` raises is a bug.
        """

    def read(self, timeout_s: float) -> Picture | None:
        """The newest picture, None if none came in time; SourceError when the camera has gone."""

    def close(self) -> None:
        """End, whatever state it is in; can be called twice."""
