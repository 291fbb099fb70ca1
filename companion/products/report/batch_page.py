"""HTML page about all flights of a batch: a row and a picture for each."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from companion.products.report.templates import rendered


@dataclass(frozen=True, slots=True)
class BatchResult:
    """Outcome of one flight: `error` or "", and the numbers of its `report` where it has one."""

    name: str
    flight: Path
    error: str
    report: dict[str, Any]
    done_before: bool = False


@dataclass(frozen=True, slots=True)
class MergedFlight:
    """Share of one flight in a map: its keyframes, the way along them, the points they observe.

    Of these `n_shared` are observed by other flights too, from which it is `apart_m` away there:
    one standard deviation, of one axis; None where they are too few to tell.
    """

    flight: str
    path_m: float
    n_keyframes: int
    n_points: int
    n_shared: int
    apart_m: float | None


@dataclass(frozen=True, slots=True)
class MergedMap:
    """A site map of several flights, or of one that shows no place of the others."""

    name: str
    n_keyframes: int
    n_points: int
    flights: tuple[MergedFlight, ...]
    refused: tuple[str, ...] = ()
    """Reasons why maps that show a place of it did not become one with it."""


def batch_page(
    rows: Sequence[BatchResult], pictures: Mapping[str, bytes], maps: Sequence[MergedMap] = ()
) -> bytes:
    """HTML with the pictures, JPEG by name, embedded; links to the reports; merged maps."""
    return rendered(
        "batch.html.j2",
        rows=[_shown(row, pictures.get(row.name, b"")) for row in rows],
        n_failed=sum(bool(row.error) for row in rows),
        maps=maps,
    )


def _shown(row: BatchResult, picture: bytes) -> dict[str, Any]:
    report = row.report
    unit = report.get("unit") or ""
    duration_s, length = report.get("duration_s"), report.get("path_length")
    minutes, seconds = divmod(round(duration_s or 0), 60)
    return {
        "name": row.name,
        "flight": str(row.flight),
        "error": row.error,
        "has_report": bool(report),
        "picture": base64.b64encode(picture).decode() if picture else "",
        "when": _when(report.get("first_unix_s")),
        "duration": f"{minutes}:{seconds:02d} min" if duration_s is not None else "",
        "tracked": f"{100 * report['tracked_share']:.1f} %" if "tracked_share" in report else "",
        "length": f"{length:.0f} {unit}" if length is not None else "",
        "points": f"{report['points']:,}" if "points" in report else "",
        "warnings": sum(each.get("count", 0) for each in report.get("warnings", [])),
    }


def _when(unix_s: Any) -> str:
    if unix_s is None:
        return ""
    when = datetime.fromtimestamp(float(unix_s), tz=timezone.utc)
    return when.strftime("%Y-%m-%d %H:%M UTC") if when.year >= 2000 else ""
