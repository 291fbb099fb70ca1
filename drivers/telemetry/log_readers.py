"""Logs of a flight, and whether they overlap the images in time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from companion.config import TelemetryConfig
from companion.errors import FlightError
from companion.messages import Warned
from drivers.telemetry.telemetry_csv import NAME, read_telemetry_csv
from drivers.telemetry.telemetry_dataflash import read_dataflash
from drivers.telemetry.telemetry_gpmf import read_gpmf
from drivers.telemetry.telemetry_log import (
    HostTimes,
    LogContent,
    Pictures,
    TelemetryLog,
    no_telemetry,
)
from drivers.telemetry.telemetry_srt import read_srt
from drivers.telemetry.telemetry_tlog import read_tlog
from drivers.telemetry.telemetry_ulog import read_ulog

READERS: dict[str, Callable[[Path], LogContent]] = {
    ".tlog": read_tlog,
    ".bin": read_dataflash,
    ".ulg": read_ulog,
    ".csv": read_telemetry_csv,
}
Times = NDArray[np.int64]


def logs_in(folder: Path) -> list[Path]:
    """Telemetry logs of a folder."""
    found = (p for p in folder.iterdir() if p.suffix.lower() in READERS)
    return sorted(p for p in found if p.suffix.lower() != ".csv" or p.name == NAME)


def logs_beside(video: Path) -> list[Path]:
    """Telemetry logs with a video's name."""
    return [path for path in logs_in(video.parent) if path.stem == video.stem]


def logs_asked_for(config: TelemetryConfig, beside: Sequence[Path]) -> list[Path]:
    """The configured log, else those found there; FlightError where it is none."""
    if not config.log:
        return list(beside)
    path = Path(config.log)
    if not path.exists():
        raise FlightError(f"{path}: there is no such telemetry log")
    if not path.is_file() or path.suffix.lower() not in READERS:
        kinds = ", ".join(READERS)
        raise FlightError(f"{path}: no telemetry log; wanted is a file with one of {kinds}")
    return [path]


def read_log_file(path: Path) -> LogContent:
    """Content of a log; FlightError where it cannot be read."""
    try:
        return READERS[path.suffix.lower()](path)
    except OSError as error:
        raise FlightError(f"{path}: cannot be read: {error.strerror}") from error


def read_telemetry(
    paths: Sequence[Path], pictures: Pictures, config: TelemetryConfig
) -> TelemetryLog:
    """Telemetry of these logs, or without any of the video itself, on the flight's clock.

    Of several logs the one that covers most of the images' time. FlightError where there are logs
    and none covers it, or where one was named and holds nothing.
    """
    found = [(path, aligned(read_log_file(path), pictures, config)) for path in paths]
    if not paths:
        inside = read_gpmf(pictures.path, pictures.host_from_file_ns)
        if inside is None and pictures.path.is_file():
            inside = read_srt(pictures.path, pictures.host_from_file_ns)
        if inside is None:
            return no_telemetry(pictures)
        found.append((pictures.path, aligned(inside, pictures, config)))
    usable = [(path, log) for path, log in found if _overlap_ns(log, pictures) > 0]
    if usable:
        path, log = max(usable, key=lambda each: _overlap_ns(each[1], pictures))
        if len(found) == 1:
            return log
        names = ", ".join(other.name for other, _ in found)
        several = Warned(
            pictures.start_ns, "several telemetry logs", f"{names}; taken: {path.name}"
        )
        return dataclasses.replace(log, warnings=(several, *log.warnings))
    apart = [(path, log) for path, log in found if log.samples]
    if apart:
        raise FlightError(_of_another_time(*apart[0], pictures))
    path, log = found[0]
    if config.log:
        why = "; ".join(f"{each.what}: {each.detail}" for each in log.warnings)
        raise FlightError(
            f"{path}: no telemetry that can be used{f' ({why})' if why else ''}; without --log, or "
            "telemetry.log, it goes on without any"
        )
    empty = Warned(pictures.start_ns, "no telemetry that can be used", path.name)
    return dataclasses.replace(log, warnings=(*log.warnings, empty))


def aligned(content: LogContent, pictures: Pictures, config: TelemetryConfig) -> TelemetryLog:
    """Content of a log on the flight's clock, with the configured shift applied."""
    shift_ns = round(config.offset_s * 1e9)
    host_ns = content.host_ns
    # a reader that knows the autopilot's clock only cannot say when
    warnings = [
        dataclasses.replace(warned, t_ns=warned.t_ns or pictures.start_ns)
        for warned in content.warnings
    ]
    if host_ns is None and len(content.collected):
        if not config.starts_with_video:
            what = "telemetry has no absolute time and is not used"
            detail = f"{content.collected.source}; "
            detail += "expert.telemetry.starts_with_video takes it as it is"
            warnings.append(Warned(pictures.start_ns, what, detail))
            return TelemetryLog(content.collected.source, (), warnings=tuple(warnings))
        what = "telemetry has no absolute time and is taken to begin with the video"
        warnings.append(Warned(pictures.start_ns, what, content.collected.source))
        to_start_ns = pictures.start_ns - int(content.collected.stamps()[0].min())
        host_ns = _shifted(unchanged, to_start_ns)
    clock = content.clock
    if clock is not None and shift_ns:
        clock = dataclasses.replace(clock, offset_s=clock.offset_s + config.offset_s)
    armed = [
        dataclasses.replace(sample, t_ns=sample.t_ns + shift_ns) for sample in content.on_host_clock
    ]
    return content.collected.finish(
        _shifted(host_ns or unchanged, shift_ns), clock, warnings, armed
    )


def _shifted(host_ns: HostTimes, shift_ns: int) -> HostTimes:
    def times(remote_ns: Times, segment: Times) -> Times:
        moved: Times = host_ns(remote_ns, segment) + shift_ns
        return moved

    return times


def unchanged(remote_ns: Times, segment: Times) -> Times:
    """Times of a log that is on the flight's clock already."""
    return remote_ns


def _overlap_ns(log: TelemetryLog, pictures: Pictures) -> int:
    if not log.samples:
        return 0
    first_ns, last_ns = log.samples[0].t_ns, log.samples[-1].t_ns
    return min(last_ns + 1, pictures.stop_ns) - max(first_ns, pictures.start_ns)


def _of_another_time(path: Path, log: TelemetryLog, pictures: Pictures) -> str:
    first_s, last_s = log.samples[0].t_ns * 1e-9, log.samples[-1].t_ns * 1e-9
    return (
        f"{path}: it is of another time than the pictures: telemetry {first_s:.1f} to {last_s:.1f}"
        f" s, pictures {pictures.start_ns * 1e-9:.1f} to {pictures.stop_ns * 1e-9:.1f} s Unix time;"
        " set expert.telemetry.offset_s if a clock was wrong"
    )
