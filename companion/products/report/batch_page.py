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
    """Outcome of one flight: `error`, or "" and the numbers of its `report`."""

    name: str
    flight: Path
    error: str
    report: dict[str, Any]
    done_before: bool = False


def batch_page(rows: Sequence[BatchResult], pictures: Mapping[str, bytes]) -> bytes:
    """HTML with the pictures, JPEG by name, embedded; links to the reports."""
    return rendered(
        "batch.html.j2",
        rows=[_shown(row, pictures.get(row.name, b"")) for row in rows],
        n_failed=sum(bool(row.error) for row in rows),
    )


def _shown(row: BatchResult, picture: bytes) -> dict[str, Any]:
    report = row.report
    unit = report.get("unit") or ""
    duration_s, length = report.get("duration_s"), report.get("path_length")
    return {
        "name": row.name,
        "flight": str(row.flight),
        "error": row.error,
        "picture": base64.b64encode(picture).decode() if picture else "",
        "when": _when(report.get("first_unix_s")),
        "duration": f"{duration_s / 60:.1f} min" if duration_s is not None else "",
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
