"""Which log a flight folder has, and whether it is of the same flight as the video."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

from companion.config import TelemetryConfig
from companion.errors import FlightError
from companion.messages import Warned
from drivers.telemetry_log import TelemetryLog
from drivers.telemetry_tlog import read_tlog

READERS: dict[str, Callable[[Path], TelemetryLog]] = {".tlog": read_tlog}


def read_telemetry(
    folder: Path, pictures: Path, start_ns: int, stop_ns: int, config: TelemetryConfig
) -> TelemetryLog:
    """The log in a folder, shifted as configured; FlightError where it is of another time."""
    logs = sorted(p for p in folder.iterdir() if p.suffix.lower() in READERS)
    if not logs:
        missing = Warned(start_ns, "no telemetry: neither scale nor level will be known")
        return TelemetryLog("", (), warnings=(missing,))
    log = READERS[logs[0].suffix.lower()](logs[0])
    if not log.samples:
        empty = Warned(start_ns, "the telemetry is empty", logs[0].name)
        return dataclasses.replace(log, warnings=(*log.warnings, empty))
    first_ns, last_ns = log.samples[0].t_ns, log.samples[-1].t_ns
    if last_ns < start_ns or first_ns >= stop_ns:
        raise FlightError(
            f"{logs[0]}: it is of another time than the video: telemetry "
            f"{first_ns * 1e-9:.1f} to {last_ns * 1e-9:.1f} s, video {start_ns * 1e-9:.1f} to "
            f"{stop_ns * 1e-9:.1f} s Unix time; set telemetry.offset_s if a clock was wrong"
        )
    return log
