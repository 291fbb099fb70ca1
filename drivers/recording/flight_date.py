"""Corrected date of a flight, where the computer's clock was wrong at its beginning.

`date.json` in the flight's folder has the correction for all times of its recording, which stay
unchanged. The folder is renamed by the date when nobody writes there any more; a single step, which
after a power cut is done or not done, and is made up for later.
"""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path

from companion.products.atomic_file import write_atomically
from drivers.recording.flights_folder import (
    STAMPED,
    flight_name,
    is_recorded_now,
    number_of,
)

FILE = "date.json"


@dataclass(frozen=True, slots=True)
class FlightDate:
    """Begin of a flight, Unix time, and the correction for the times in its recording."""

    began_unix_s: float
    correction_s: float
    by: str
    """Source of the date."""


def write_date(flight: Path, date: FlightDate) -> None:
    """Write it into a flight's folder, atomically; OSError where impossible."""
    write_atomically(flight / FILE, json.dumps(asdict(date)).encode() + b"\n", durable=True)


def read_date(flight: Path) -> FlightDate | None:
    """Date of a flight's folder; None where the clock was right, as far as is known."""
    try:
        document = json.loads((flight / FILE).read_bytes())
        return FlightDate(
            float(document["began_unix_s"]), float(document["correction_s"]), str(document["by"])
        )
    except (OSError, ValueError, KeyError, TypeError):
        return None


def named_by_date(flight: Path) -> Path:
    """Rename a flight's folder by its date; returns its path.

    Nothing is done while it is recorded, nor to a folder without a number, by which flights are
    ordered whatever their names say.
    """
    date, number = read_date(flight), number_of(flight.name)
    if date is None or number is None or not STAMPED.fullmatch(flight.name):
        return flight
    named = flight.with_name(flight_name(number, date.began_unix_s))
    if named == flight or named.exists() or is_recorded_now(flight):
        return flight
    try:
        os.rename(flight, named)
    except OSError:
        return flight
    return named
