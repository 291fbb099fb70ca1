"""Flights as the page lists them: size, report's numbers, path as a small drawing, files."""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from companion.errors import FlightError
from drivers.recording.flights_folder import (
    KEEP,
    FlightPlace,
    began_unix_s,
    delete,
    flown_in,
    free_bytes,
    in_order,
    number_of,
)

SHOWN = {
    "report.html": "the flight on one page, with its cloud to be turned",
    "flight.mcap": "recording: for a replay, and for Foxglove",
    "cloud.ply": "coloured points, local north, east, down in metres",
    "trajectory.tum": "path: time, place and attitude of each picture",
    "site.map": "map to fly in again (map.use)",
    "report.json": "numbers of the report",
    "flight.tlog": "MAVLink, for ground stations",
    "flight.rrd": "for the Rerun viewer",
}
"""Files named first, in this order, and what they are."""
MOST_FILES = 200
MOST_BYTES = 8 << 20
"""Bytes of a path, or of a report, that are read for the list."""
N_PATH = 150
SIDE = 100
"""Side of the drawing, in its own units."""
MB = 1e6


@dataclass(frozen=True, slots=True)
class Flown:
    """One flight. Numbers are None where it has no report."""

    name: str
    mb: float
    kept: bool
    growing: bool
    duration_s: float | None
    path_m: float | None
    unit: str
    n_points: int | None
    drawing: str
    """Path from above as the points of an SVG polyline, north up; "" without one."""

    @property
    def title(self) -> str:
        """Number and time of the flight for its reader, else its name."""
        number, began_s = number_of(self.name), began_unix_s(self.name)
        if number is None:
            return self.name
        if began_s is None:
            return f"Flight {number}, the clock was not set"
        began = datetime.fromtimestamp(began_s, timezone.utc)
        return f"Flight {number}, {began.day} {began:%b %Y, %H:%M} UTC"


class FlownFlights:
    """Flights in a folder, as the daemon keeps them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._known: dict[tuple[str, int], tuple[dict[str, Any], str]] = {}
        """Report and drawing by name and time of the report: they are read once."""

    def all(self) -> list[Flown]:
        """All flights, the newest first; FlightError where the folder cannot be read."""
        if not self.folder.is_dir():
            return []
        return [self._flown(place) for place in reversed(flown_in(self.folder))]

    def one(self, name: str) -> Flown:
        """A flight by its name; FlightError without it."""
        return self._flown(self._place(name))

    def files(self, name: str) -> list[tuple[str, float]]:
        """Files of a flight, and their sizes in MB; the ones most asked for first.

        A cloud without points, as a flight without a dense map leaves it, is none of them.
        """
        folder = self._place(name).path
        no_points = self._results(folder)[0].get("points") == 0
        left_out = folder / "cloud.ply" if no_points else None
        found = [
            (path.relative_to(folder).as_posix(), path.stat().st_size / MB)
            for path in sorted(folder.rglob("*"))
            if path.is_file()
            and not path.is_symlink()
            and not path.name.startswith(".")
            and path != left_out
        ]
        order = {each: n for n, each in enumerate(SHOWN)}
        found.sort(key=lambda each: (order.get(each[0], len(order)), each[0]))
        return found[:MOST_FILES]

    def file(self, name: str, file: str) -> Path:
        """Path of a file that `files` names; FlightError for any other."""
        if file not in [each for each, _ in self.files(name)]:
            raise FlightError(f"{name}: there is no file {file}")
        return self._place(name).path / file

    def delete(self, name: str) -> None:
        """Delete a flight with all that it has; FlightError where that may not be."""
        place = self._place(name)
        if place.growing:
            raise FlightError(f"{name}: is being recorded")
        if place.kept:
            raise FlightError(f"{name}: is kept; take the mark away first")
        try:
            delete(place)
        except OSError as error:
            raise FlightError(f"{name}: cannot be deleted: {error.strerror}") from error

    def keep(self, name: str, kept: bool) -> None:
        """Protect a flight from deletion, or no longer."""
        mark = self._place(name).path / KEEP
        try:
            mark.touch() if kept else mark.unlink(missing_ok=True)
        except OSError as error:
            raise FlightError(f"{name}: cannot be marked: {error.strerror}") from error

    def free_mb(self) -> float | None:
        """Free space; None where the folder is not there."""
        try:
            return free_bytes(self.folder) / MB
        except OSError:
            return None

    def _place(self, name: str) -> FlightPlace:
        if not in_order([name]):
            raise FlightError(f"{name}: is no flight's name")
        found = (each for each in flown_in(self.folder) if each.path.name == name)
        place = next(found, None)
        if place is None:
            raise FlightError(f"{name}: there is no such flight")
        return place

    def _flown(self, place: FlightPlace) -> Flown:
        report, drawing = self._results(place.path)
        duration_s, path_m = report.get("duration_s"), report.get("path_length")
        n_points = report.get("points")
        return Flown(
            place.path.name, place.n_bytes / MB, place.kept, place.growing,
            duration_s if isinstance(duration_s, (int, float)) else None,
            path_m if isinstance(path_m, (int, float)) else None,
            str(report.get("unit", "")), n_points if isinstance(n_points, int) else None, drawing,
        )  # fmt: skip

    def _results(self, folder: Path) -> tuple[dict[str, Any], str]:
        file = folder / "report.json"
        try:
            key = folder.name, file.stat().st_mtime_ns
        except OSError:
            return {}, ""
        if key not in self._known:
            try:
                report = json.loads(_read(file))
            except (OSError, ValueError):
                report = {}
            found = report if isinstance(report, dict) else {}
            self._known[key] = found, _drawing(folder / "trajectory.tum")
        return self._known[key]


def _read(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(MOST_BYTES)


def _drawing(path: Path) -> str:
    try:
        rows = [line.split()[1:3] for line in _read(path).splitlines() if line[:1] != b"#"]
        rows = rows[:: max(1, len(rows) // N_PATH)]
        north, east = np.array([row for row in rows if len(row) == 2], float).T
    except (OSError, ValueError):
        return ""
    if not (np.isfinite(north).all() and np.isfinite(east).all()):
        return ""
    width = max(float(np.ptp(north)), float(np.ptp(east)), 1e-9)
    x = SIDE / 2 + (east - (east.max() + east.min()) / 2) / width * SIDE * 0.9
    y = SIDE / 2 - (north - (north.max() + north.min()) / 2) / width * SIDE * 0.9
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
