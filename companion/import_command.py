"""companion import: a flight of any format that can be read, as a flight folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from companion.config import Config
from companion.errors import InputError
from companion.progress import Progress
from drivers.flight_folder_writer import write_flight_folder
from drivers.open_flight import open_flight


def import_flight(
    source: Path, out: Path, config: Config, progress: Progress, told: Callable[[str], None]
) -> int:
    """Read a flight and write it as a folder; return how many frames it has.

    `told` hears what was amiss. InputError where it cannot be read, or not be written.
    """
    if out.suffix:
        raise InputError(f"{out}: only folders are written; recordings are what `run` makes")
    flight = open_flight(source, config.camera, config.telemetry)
    log = flight.telemetry()
    for remark in log.remarks:
        told(remark)
    for warned in (*flight.warnings, *log.warnings):
        told(f"{warned.what}: {warned.detail}" if warned.detail else warned.what)
    progress.start(flight.n_frames)
    try:
        return write_flight_folder(flight, out, lambda n: progress.update(n, "imported", 0))
    finally:
        progress.finish()
