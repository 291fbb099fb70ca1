"""companion flights: list, show, trim, export, verify and prune recordings of live flights."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from companion.app.progress import Progress
from companion.errors import FlightError, InputError
from companion.products.trajectory_file import exact_seconds
from companion.timing.clock import FlightClock
from drivers.recording.exporting import export
from drivers.recording.flight_date import named_by_date, read_date
from drivers.recording.flight_summary import FlightSummary, summarise
from drivers.recording.flights_folder import (
    KEEP,
    RECORDING,
    FlightPlace,
    delete,
    flights_in,
    flown_in,
    free_bytes,
    may_go,
    recordings_in,
)
from drivers.recording.recording_reader import with_pictures
from drivers.recording.trimming import trim

MB = 1 << 20
DAY_S = 86400


def found_recording(given: str, folder: Path) -> Path:
    """Path of a recording given as a file, a flight's folder, or a flight's name in `folder`."""
    for path in (Path(given), folder / given):
        if path.is_file():
            return path
        if (path / RECORDING).is_file():
            return path / RECORDING
    raise FlightError(f"{given}: no recording, and no flight of this name in {folder}")


def recordings_meant(given: Sequence[str], folder: Path) -> list[Path]:
    """Recordings of these flights; of all in `folder` where none is named."""
    if not given:
        return [path for flight in flown_in(folder) for path in recordings_in(flight.path)]
    return [found_recording(each, folder) for each in given]


def correct_names(folder: Path) -> None:
    """Rename flights by corrected dates where the daemon had no time; not those being recorded."""
    for flight in flights_in(folder):
        named_by_date(flight.path)


def correction_ns(path: Path) -> int:
    """Correction to add to the times of a recording, ns."""
    flight = path.parent.parent if path.parent.name.startswith("part-") else path.parent
    date = read_date(flight)
    return 0 if date is None else round(date.correction_s * 1e9)


def list_flights(folder: Path, as_json: bool) -> str:
    """One line for each recording, the oldest first."""
    rows = [
        {
            "path": os.fspath(path),
            "flight": flight.path.name + ("" if path.parent == flight.path else f"/{part}"),
            "start": _when(summary.start_ns + correction_ns(path)) if summary.start_ns else None,
            "duration_s": round(summary.duration_s, 1),
            "pictures": summary.n_pictures,
            "mb": round(flight.n_bytes / MB, 1),
            "state": summary.state + (", kept" if flight.kept else ""),
        }
        for flight, path, part, summary in _summaries(flown_in(folder))
    ]
    if as_json:
        return json.dumps(rows, indent=2)
    if not rows:
        return f"{folder}: no recorded flight"
    lines = [f"{'flight':<34}{'minutes':>8}{'pictures':>10}{'MB':>9}  state"]
    for row in rows:
        lines.append(
            f"{row['flight']!s:<34}{float(str(row['duration_s'])) / 60:>8.1f}{row['pictures']:>10}"
            f"{row['mb']:>9}  {row['state']}"
        )
    free, plural = free_bytes(folder) / MB, "" if len(rows) == 1 else "s"
    return "\n".join([*lines, f"{len(rows)} recording{plural} in {folder}, {free:.0f} MB free"])


def show_flight(path: Path, as_json: bool) -> str:
    """Description of a recording."""
    summary, correction = summarise(path), correction_ns(path)
    if as_json:
        return json.dumps(_document(summary, correction), indent=2)
    lines = [
        f"{path}: {summary.state}",
        f"  from {_when(summary.start_ns + correction)}, {summary.duration_s:.1f} s, "
        f"{summary.n_bytes / MB:.1f} MB",
    ]
    if correction:
        lines.append(f"  the clock was not set: its times are {correction * 1e-9:+.0f} s off")
    if summary.n_lost_bytes:
        lines.append(f"  {summary.n_lost_bytes} bytes cannot be read")
    lines += [
        f"  {name}: " + ", ".join(f"{k} {v}" for k, v in sorted(words.items()))
        for name, words in sorted(summary.metadata.items())
    ]
    for topic, n in summary.counts.items():
        rate = f"{(n - 1) / summary.duration_s:8.1f} Hz" if n > 1 and summary.duration_s else ""
        lines.append(f"  {topic:<24}{n:>8}{rate}")
    return "\n".join(lines)


def verify_flights(paths: Sequence[Path], progress: Progress) -> tuple[str, bool]:
    """Check all checksums; a line for each recording, and whether all are intact."""
    total = sum(path.stat().st_size for path in paths if path.is_file())
    progress.start(max(1, total // MB))
    lines, done, good = [], 0, True
    for path in paths:
        before = done

        def on_progress(n_bytes: int, before: int = before) -> None:
            progress.update((before + n_bytes) // MB, "checked", 0)

        try:
            summary = summarise(path, on_progress)
        except FlightError as error:
            lines.append(str(error))
            good = False
            continue
        done += summary.n_bytes
        well = summary.state in ("whole", "repaired", "being recorded")
        good = good and well
        detail = f"{summary.n_pictures} pictures, {summary.n_bytes / MB:.1f} MB"
        if not well:
            detail += f", {summary.n_lost_bytes} bytes cannot be read"
        lines.append(f"{path}: {summary.state} ({detail})")
    progress.finish()
    return "\n".join(lines), good


def trim_flight(
    path: Path, start_s: float | None, stop_s: float | None, out: Path, progress: Progress
) -> str:
    """Write a time span, in seconds from the first image, to a recording of its own."""
    recording = with_pictures(path)
    try:
        first_ns, last_ns = recording.pictures[0].t_ns, recording.pictures[-1].t_ns
        start_ns = first_ns + round((start_s or 0.0) * 1e9)
        stop_ns = last_ns + 1 if stop_s is None else first_ns + round(stop_s * 1e9)
        progress.start(max(1, recording.file.size // MB))
        out.parent.mkdir(parents=True, exist_ok=True)
        n = trim(
            recording, start_ns, stop_ns, out,
            lambda n_bytes: progress.update(n_bytes // MB, "copied", 0),
        )  # fmt: skip
    finally:
        progress.finish()
        recording.close()
    return f"{out}: {n} pictures, {out.stat().st_size / MB:.1f} MB"


def export_flight(path: Path, out: Path, progress: Progress) -> str:
    """Write a recording as a flight folder."""
    recording = with_pictures(path)
    try:
        progress.start(len(recording.pictures))
        export(recording, out, lambda n: progress.update(n, "written", 0))
        n = len(recording.pictures)
    finally:
        progress.finish()
        recording.close()
    return f"{out}: {n} pictures"


def prune_flights(
    folder: Path, *, keep_newest: int | None, older_than_days: float | None,
    free_mb: float | None, dry_run: bool,
) -> str:  # fmt: skip
    """Delete finished flights, the oldest first, while one of the given conditions holds."""
    if keep_newest is None and older_than_days is None and free_mb is None:
        raise InputError("say what may go: --keep-newest, --older-than or --free")
    flights = flights_in(folder)
    now_ns = FlightClock().now_ns()
    going = list(may_go(flights))
    if keep_newest is not None:
        newest = {flight.path for flight in flights[max(0, len(flights) - keep_newest) :]}
        going = [flight for flight in going if flight.path not in newest]
    if older_than_days is not None:
        going = [f for f in going if _age_s(f, now_ns) > older_than_days * DAY_S]
    if free_mb is not None:
        going = _enough(going, free_mb * MB - free_bytes(folder))
    lines = []
    for flight in going:
        try:
            if not dry_run:
                delete(flight)
        except OSError as error:
            raise FlightError(f"{flight.path}: cannot be deleted: {error.strerror}") from error
        lines.append(f"{flight.path}: {'would be ' if dry_run else ''}deleted")
    mb = sum(flight.n_bytes for flight in going) / MB
    kept = sum(flight.kept for flight in flights)
    note = f", {kept} kept by a file named {KEEP}" if kept else ""
    lines.append(f"{len(going)} of {len(flights)} flights, {mb:.0f} MB{note}")
    return "\n".join(lines)


def _summaries(
    flights: Sequence[FlightPlace],
) -> Iterator[tuple[FlightPlace, Path, str, FlightSummary]]:
    for flight in flights:
        for path in recordings_in(flight.path):
            try:
                summary = summarise(path)
            except FlightError:
                summary = FlightSummary(path, "damaged", path.stat().st_size, 0, 0)
            yield flight, path, path.parent.name, summary


def _document(summary: FlightSummary, correction: int) -> dict[str, Any]:
    return {
        "path": os.fspath(summary.path), "state": summary.state, "bytes": summary.n_bytes,
        "start_unix_s": exact_seconds(summary.start_ns + correction),
        "clock_correction_s": correction * 1e-9, "duration_s": summary.duration_s,
        "pictures": summary.n_pictures, "lost_bytes": summary.n_lost_bytes,
        "topics": summary.counts, "metadata": summary.metadata,
        "attachments": sorted(summary.attachments),
    }  # fmt: skip


def _enough(going: Sequence[FlightPlace], needed: float) -> list[FlightPlace]:
    out = []
    for flight in going:
        if needed <= 0:
            break
        out.append(flight)
        needed -= flight.n_bytes
    return out


def _age_s(flight: FlightPlace, now_ns: int) -> float:
    """Seconds since it began, at least; 0 where no clock tells."""
    return 0.0 if flight.began_s is None else now_ns * 1e-9 - flight.began_s


def _when(t_ns: int) -> str:
    return datetime.fromtimestamp(t_ns * 1e-9, tz=timezone.utc).strftime("%Y-%m-%d %H:%M:%S UTC")
