"""Dates of flights on a computer that gets the time only after it has started.

A computer without a battery clock starts with the time at which it was switched off, or with 1970.
Its flights are ordered by their numbers all the same; when the time comes, from the network or the
autopilot's GPS, flights of this run of the daemon get their dates.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from companion.timing.clock import FlightClock
from drivers.recording.flight_date import FlightDate, named_by_date, write_date
from drivers.recording.flights_folder import PROGRAM_UNIX_S

WRONG_NS = 2_000_000_000
"""Names have seconds; a smaller clock error needs no new name."""
LOOK_NS = 1_000_000_000
MOST_FLIGHTS = 1000
"""Most flights whose date is still unknown."""


@dataclass(slots=True)
class _Flight:
    began_ns: int
    """Flight's clock."""
    over: bool = False
    corrected_ns: int = 0
    """Correction in its date file."""


class FlightDates:
    """Dates of the flights of this run of the daemon, and their correction.

    `ahead_ns` is the autopilot's date minus the flight's clock, None without one; `is_set` is True
    if the system's clock is synchronised. For the event loop, except `ended` and `write`, which
    wait for the disk.
    """

    def __init__(
        self, clock: FlightClock, ahead_ns: Callable[[], int | None], is_set: Callable[[], bool]
    ) -> None:
        self._clock, self._ahead_ns, self._is_set = clock, ahead_ns, is_set
        self._lock, self._writing = threading.Lock(), threading.Lock()
        self._looked_ns = -LOOK_NS
        self._found: tuple[int, str] | None = None
        self._flights: dict[Path, _Flight] = {}
        """By folder; those of this run."""

    def unix_s(self, t_ns: int) -> float:
        """Unix time of a time of the flight's clock, by the best correction known."""
        found = self._found
        return (t_ns + (found[0] if found is not None else 0)) * 1e-9

    def begun(self, folder: Path, t_ns: int) -> None:
        """A flight has begun in this folder."""
        with self._lock:
            if len(self._flights) < MOST_FLIGHTS:
                self._flights[folder] = _Flight(t_ns)

    def ended(self, folder: Path) -> Path:
        """A flight's folder is complete; returns its new path."""
        with self._lock:
            flight = self._flights.get(folder)
            if flight is None:
                return folder
            flight.over = True
        return self.write().get(folder, folder)

    def deleted(self, folder: Path) -> None:
        """A flight's folder is gone."""
        with self._lock:
            self._flights.pop(folder, None)

    def step(self) -> bool:
        """Check the clock, once a second; True if there is something to `write`."""
        now_ns = self._clock.now_ns()
        if now_ns - self._looked_ns < LOOK_NS:
            return False
        self._looked_ns = now_ns
        found, before = self._look(now_ns), self._found
        if found is not None and (before is None or abs(found[0] - before[0]) >= WRONG_NS):
            self._found = found
        with self._lock:
            return any(self._is_due(flight) for flight in self._flights.values())

    def write(self) -> dict[Path, Path]:
        """Write dates, and rename folders of finished flights; new paths by old path."""
        moved: dict[Path, Path] = {}
        with self._writing:
            with self._lock:
                flights = dict(self._flights)
            for folder, flight in flights.items():
                if self._is_due(flight):
                    self._date(folder, flight)
                if flight.over and flight.corrected_ns:
                    now_at = named_by_date(folder)
                    if now_at != folder:
                        moved[folder] = now_at
            with self._lock:
                for folder, now_at in moved.items():
                    self._flights[now_at] = self._flights.pop(folder)
        return moved

    def _date(self, folder: Path, flight: _Flight) -> None:
        if not folder.is_dir():  # its stages are yet to make it, or it was deleted since
            if flight.over:
                with self._lock:
                    self._flights.pop(folder, None)
            return
        assert self._found is not None
        correction_ns, by = self._found
        began_s = (flight.began_ns + correction_ns) * 1e-9
        try:
            write_date(folder, FlightDate(began_s, correction_ns * 1e-9, by))
        except OSError:
            return  # a full disk: its number orders it, and the next look tries again
        flight.corrected_ns = correction_ns

    def _is_due(self, flight: _Flight) -> bool:
        found = self._found
        return found is not None and abs(found[0] - flight.corrected_ns) >= WRONG_NS

    def _look(self, now_ns: int) -> tuple[int, str] | None:
        """Correction of the flight's clock and its source; None while unknown."""
        set_ns, autopilot_ns = self._clock.behind_ns(), self._ahead_ns()
        if self._is_set():
            return _plausible(now_ns, set_ns, "the network")
        if autopilot_ns is not None:
            found = _plausible(now_ns, autopilot_ns, "the autopilot")
            if found is not None:
                return found
        if abs(set_ns) >= WRONG_NS:  # set since the start
            return _plausible(now_ns, set_ns, "the system's clock, which was set")
        return None


def _plausible(now_ns: int, correction_ns: int, by: str) -> tuple[int, str] | None:
    later = (now_ns + correction_ns) * 1e-9 > PROGRAM_UNIX_S
    return (correction_ns, by) if later else None
