"""The folder of flights: list, order, and flights that may be deleted.

Flights are ordered by their numbers: a computer without a battery clock names them by whatever time
it has. Those without a number are older than numbered ones.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterable, Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import NamedTuple

from companion.errors import FlightError
from drivers.recording.growing_file import is_growing

RECORDING, TLOG = "flight.mcap", "flight.tlog"
KEEP = "keep"
"""A file of this name in a flight's folder protects it from deletion."""
UNARMED = "not-armed"
"""Marks a flight whose motors were not armed yet; its folder goes when it ends. One that is left,
as the power was cut, is not listed, and is the first to be deleted."""
COUNTER = ".last-number"
"""Holds the number of the newest flight, which may have been deleted or moved since."""
STAMPED = re.compile(r"(?:(\d{5,})-)?(\d{4}-\d\d-\d\dT\d\d-\d\d-\d\dZ)(?:-\d+)?")
"""Names of flights by the daemon; nothing else is ever deleted."""
STAMP = "%Y-%m-%dT%H-%M-%SZ"
PROGRAM_UNIX_S = 1767225600.0
"""2026-01-01: no flight was recorded before; an earlier date is of a clock that was not set."""


class FlightPlace(NamedTuple):
    """Folder of a flight, which has a recording or once had."""

    path: Path
    n_bytes: int
    kept: bool
    growing: bool
    """True while it is being recorded."""
    unarmed: bool = False
    """True as long as its motors were never armed."""
    began_s: float | None = None
    """Its begin, Unix time, by its name and those before it in order. Of one whose clock was not
    set, that of the next with a date, which it is not younger than; None where there is none."""


def flights_in(folder: Path) -> list[FlightPlace]:
    """All folders of flights, the oldest first; FlightError where the folder cannot be read."""
    try:
        names = in_order(each.name for each in os.scandir(folder) if each.is_dir())
    except FileNotFoundError as error:
        raise FlightError(f"{folder}: not there; --flights names a folder of flights") from error
    except PermissionError as error:
        hint = "join the group companion, or use sudo"
        raise FlightError(f"{folder}: may not be read by this user; {hint}") from error
    except OSError as error:
        raise FlightError(f"{folder}: cannot be read: {error.strerror}") from error
    dates = _begins_s(names)
    return [_place(folder / name, date) for name, date in zip(names, dates, strict=True)]


def flown_in(folder: Path) -> list[FlightPlace]:
    """The same without those whose motors were not armed."""
    return [flight for flight in flights_in(folder) if not flight.unarmed]


def flight_name(number: int, unix_s: float) -> str:
    """Name of a flight's folder."""
    when = datetime.fromtimestamp(unix_s, tz=timezone.utc).strftime(STAMP)
    return f"{number:05d}-{when}"


def number_of(name: str) -> int | None:
    """Number in a flight's name; None in one of an older version, or of something else."""
    found = STAMPED.fullmatch(name)
    return int(found[1]) if found is not None and found[1] else None


def began_unix_s(name: str) -> float | None:
    """Begin of a flight by its name; None where the clock was not set then."""
    found = STAMPED.fullmatch(name)
    if found is None:
        return None
    try:
        began_s = datetime.strptime(found[2], STAMP).replace(tzinfo=timezone.utc).timestamp()
    except ValueError:
        return None
    return began_s if began_s >= PROGRAM_UNIX_S else None


def in_order(names: Iterable[str]) -> list[str]:
    """Names of flights, the oldest first; other names are left out."""
    return sorted(
        (name for name in names if STAMPED.fullmatch(name)),
        key=lambda name: (number_of(name) or 0, name),
    )


def next_number(folder: Path) -> int:
    """A number higher than that of any flight, past or present."""
    numbers = [0]
    try:
        numbers += [number_of(each.name) or 0 for each in os.scandir(folder)]
        numbers.append(int((folder / COUNTER).read_bytes()[:20]))
    except (OSError, ValueError):
        pass  # lost or damaged, or there was no flight yet: those that there are tell
    return max(numbers) + 1


def recordings_in(flight: Path) -> list[Path]:
    """Recordings of a flight, its later parts included, in order."""
    parts = sorted(flight.glob("part-*/" + RECORDING), key=lambda p: (len(p.parent.name), p))
    return [path for path in (flight / RECORDING, *parts) if path.is_file()]


def free_bytes(folder: Path) -> int:
    """Free bytes of the disk available to us."""
    found = os.statvfs(folder)
    return found.f_bavail * found.f_frsize


def may_go(flights: list[FlightPlace], but: Path | None = None) -> Iterator[FlightPlace]:
    """Flights that may be deleted: finished, not kept, and not `but`.

    Those that were never armed come first, then the oldest.
    """
    in_turn = sorted(flights, key=lambda flight: not flight.unarmed)
    return (f for f in in_turn if not (f.kept or f.growing) and f.path.name != (but and but.name))


def delete(flight: FlightPlace) -> None:
    """Delete a flight with all its results; OSError where impossible."""
    shutil.rmtree(flight.path)


def is_recorded_now(flight: Path) -> bool:
    """True while a recording in a flight's folder is being written."""
    return any(map(_is_growing, recordings_in(flight)))


def _begins_s(names: list[str]) -> list[float | None]:
    """Begins of flights in order, as `FlightPlace.began_s`."""
    newest_s = 0.0
    dates: list[float | None] = []
    for own_s in map(began_unix_s, names):
        newest_s = max(newest_s, own_s or 0.0)
        dates.append(None if own_s is None else newest_s)
    next_s: float | None = None
    for k in reversed(range(len(dates))):
        next_s = dates[k] = next_s if dates[k] is None else dates[k]
    return dates


def _place(path: Path, began_s: float | None) -> FlightPlace:
    n_bytes = 0
    for folder, _, names in os.walk(path):
        for name in names:
            try:
                n_bytes += os.stat(os.path.join(folder, name)).st_blocks * 512
            except OSError:
                continue  # gone meanwhile
    return FlightPlace(
        path, n_bytes, (path / KEEP).exists(), is_recorded_now(path), (path / UNARMED).exists(),
        began_s,
    )  # fmt: skip


def _is_growing(path: Path) -> bool:
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        return is_growing(fd)
    finally:
        os.close(fd)
