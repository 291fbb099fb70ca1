"""The folder of all flights: which there are, how old, and which may go to make room."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from companion.errors import FlightError
from drivers.recording.growing_file import is_growing

RECORDING, TLOG = "flight.mcap", "flight.tlog"
KEEP = "keep"
"""A file of this name in a flight's folder keeps it from being deleted."""
STAMPED = re.compile(r"\d{4}-\d\d-\d\dT\d\d-\d\d-\d\dZ(-\d+)?")
"""What the daemon calls a flight; nothing else is ever deleted."""


class FlightPlace(NamedTuple):
    """A flight's folder, which has a recording or once had."""

    path: Path
    n_bytes: int
    kept: bool
    growing: bool
    """Whether it is still being recorded."""


def flights_in(folder: Path) -> list[FlightPlace]:
    """All flights, the oldest first; FlightError where the folder cannot be read."""
    try:
        names = sorted(each.name for each in os.scandir(folder) if each.is_dir())
    except FileNotFoundError as error:
        raise FlightError(f"{folder}: not there; --flights names a folder of flights") from error
    except PermissionError as error:
        hint = "join the group companion, or use sudo"
        raise FlightError(f"{folder}: may not be read by this user; {hint}") from error
    except OSError as error:
        raise FlightError(f"{folder}: cannot be read: {error.strerror}") from error
    return [_place(folder / name) for name in names if STAMPED.fullmatch(name)]


def recordings_in(flight: Path) -> list[Path]:
    """The recording of a flight, and those begun anew within it, in order."""
    parts = sorted(flight.glob("part-*/" + RECORDING), key=lambda p: (len(p.parent.name), p))
    return [path for path in (flight / RECORDING, *parts) if path.is_file()]


def free_bytes(folder: Path) -> int:
    """Room on the disk, as far as it is for us."""
    found = os.statvfs(folder)
    return found.f_bavail * found.f_frsize


def may_go(flights: list[FlightPlace], but: Path | None = None) -> Iterator[FlightPlace]:
    """Those that may be deleted, the oldest first: finished, not kept, and not `but`."""
    return (f for f in flights if not (f.kept or f.growing) and f.path.name != (but and but.name))


def delete(flight: FlightPlace) -> None:
    """Delete a flight with all its results; OSError where that cannot be."""
    shutil.rmtree(flight.path)


def _place(path: Path) -> FlightPlace:
    n_bytes = 0
    for folder, _, names in os.walk(path):
        for name in names:
            try:
                n_bytes += os.stat(os.path.join(folder, name)).st_blocks * 512
            except OSError:
                continue  # gone meanwhile
    growing = any(map(_is_growing, recordings_in(path)))
    return FlightPlace(path, n_bytes, (path / KEEP).exists(), growing)


def _is_growing(path: Path) -> bool:
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        return is_growing(fd)
    finally:
        os.close(fd)
