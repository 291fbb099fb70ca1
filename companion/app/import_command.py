"""companion import: any readable flight as a flight folder or recording."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from companion.app.progress import Progress
from companion.config import Config
from companion.errors import InputError
from drivers.datasets.flight_folder_writer import write_flight_folder
from drivers.flight import Flight
from drivers.open_flight import open_flight
from drivers.recording.importing import write_recording

WRITERS: dict[str, Callable[[Flight, Path, Callable[[int], None]], int]] = {
    "": write_flight_folder,
    ".mcap": write_recording,
}
"""By suffix of the output."""


def import_flight(
    source: Path, out: Path, config: Config, progress: Progress, notify: Callable[[str], None]
) -> int:
    """Read a flight and write it as a folder or, as FILE.mcap, a recording; return its frames.

    `notify` takes remarks about the source. InputError where it cannot be read or written.
    """
    if out.suffix not in WRITERS:
        raise InputError(f"{out}: wanted is the name of a folder, or of a file ending in .mcap")
    flight = open_flight(source, config.camera, config.telemetry, config.mount)
    log = flight.telemetry()
    for remark in log.remarks:
        notify(remark)
    for warned in (*flight.warnings, *log.warnings):
        notify(f"{warned.what}: {warned.detail}" if warned.detail else warned.what)
    progress.start(flight.n_frames)
    try:
        return WRITERS[out.suffix](flight, out, lambda n: progress.update(n, "imported", 0))
    finally:
        progress.finish()
