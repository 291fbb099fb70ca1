"""Results of `slam`: a table, JSON, and pictures of the paths."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path as FilePath
from typing import Any

from matplotlib.figure import Figure

from companion.products.atomic_file import write_atomically
from companion.products.report.comparison_page import shown
from tests.bench.accuracy.path_errors import Path, PathErrors, align, paired

COLUMNS = (
    ("flight", "flight"), ("fault", "fault"), ("tracked", "tracked_share"),
    ("ATE sim3", "ate_sim3_m"), ("se3", "ate_se3_m"), ("yaw", "ate_yaw_m"),
    ("live", "live_ate_m"), ("RPE", "rpe_m"), ("scale", "scale_error"),
    ("heading", "heading_error_deg"), ("worst step", "worst_step_m"),
    ("NEES", "nees"), ("NEES yaw", "nees_yaw"), ("gap s", "longest_gap_s"),
    ("dead_reckoned", "dead reckoned"),
    ("resets", "resets"), ("segments", "segments"), ("loops", "loops"), ("keyframes", "keyframes"),
    ("ms", "frame_ms_median"), ("p95", "frame_ms_p95"), ("mapping", "mapping_ms_median"),
    ("growth", "cost_growth"), ("MB", "peak_memory_mb"),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class BenchRow:
    """Measurements of one flight under one fault; lengths in metres, times in milliseconds.

    `tracked_share` is the share of frames tracked, of those that show something above the given
    height. `live_ate_m` is the ATE of poses as first published, aligned by similarity.
    `worst_step_m` is the largest error of the motion between consecutive poses of smooth odometry.
    `nees` is the normalised estimation error squared of its position since its last reset, 1 where
    its covariance is true; `nees_yaw` likewise of its heading against north, which errs slowly, so
    that one flight gives few independent samples. `longest_gap_s` is the longest time without a
    pose beyond image dropouts; `cost_growth` is the ratio of the median work per frame in the last
    fifth of the flight to the second fifth.
    """

    flight: str
    fault: str
    frames: int
    tracked_share: float
    errors: PathErrors | None
    live_ate_m: float | None
    worst_step_m: float | None
    nees: float | None
    nees_yaw: float | None
    resets: int
    longest_gap_s: float
    dead_reckoned: int
    keyframes: int
    segments: int
    loops: int
    scale_method: str
    frame_ms_median: float
    frame_ms_p95: float
    mapping_ms_median: float
    cost_growth: float
    peak_memory_mb: float
    warnings: tuple[str, ...] = ()
    paths: tuple[Path, Path] | None = field(default=None, repr=False, compare=False)


def numbers(row: BenchRow) -> dict[str, Any]:
    """Fields of one row for JSON: errors inlined, no paths, null for unknown values."""
    out = {f.name: getattr(row, f.name) for f in fields(row)}
    out.pop("paths"), out.pop("errors")
    errors = asdict(row.errors) if row.errors is not None else {}
    rounded = {k: round(v, 5) if isinstance(v, float) else v for k, v in errors.items()}
    return {k: _finite(v) for k, v in {**out, **rounded}.items()}


def table(rows: Sequence[BenchRow]) -> str:
    """Text table of all rows; lengths in metres, times in milliseconds."""
    cells = [[title for title, _ in COLUMNS]]
    for row in rows:
        values = numbers(row)
        cells.append([shown(values.get(key)) for _, key in COLUMNS])
    widths = [max(len(line[i]) for line in cells) for i in range(len(COLUMNS))]
    return "\n".join(_line(line, widths) for line in cells)


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    padded = [c.rjust(w) for c, w in zip(cells, widths, strict=True)]
    padded[:2] = [c.ljust(w) for c, w in zip(cells[:2], widths[:2], strict=True)]
    return "  ".join(padded).rstrip()


def as_json(rows: Sequence[BenchRow]) -> str:
    """JSON of all rows; ValueError on nan, which JSON has not."""
    return json.dumps([numbers(row) for row in rows], indent=2, allow_nan=False)


def write_bench(out: FilePath, rows: Sequence[BenchRow]) -> None:
    """Write slam.json and a picture of each path against the truth into folder `out`."""
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(out / "slam.json", (as_json(rows) + "\n").encode())
    for row in rows:
        if row.paths is not None and row.errors is not None:
            name = f"{row.flight} {row.fault}".replace(" none", "").replace("/", " per ")
            name = name.replace(" ", "_")
            write_atomically(out / f"{name}.svg", picture(row))


def picture(row: BenchRow) -> bytes:
    """SVG: plan view of both paths and the error over time, after alignment by similarity."""
    assert row.paths is not None
    found, wanted = paired(*row.paths)
    aligned = align(found.centres, wanted.centres, True).apply(found.centres)
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    plan, over_time = figure.subplots(1, 2)
    truth = row.paths[1].centres
    plan.plot(truth[:, 1], truth[:, 0], color="0.7", lw=3, label="truth")
    plan.plot(aligned[:, 1], aligned[:, 0], color="tab:blue", lw=1, label="estimate")
    plan.set_aspect("equal", adjustable="datalim")
    plan.set_xlabel("east [m]")
    plan.set_ylabel("north [m]")
    plan.legend(frameon=False)
    error = ((aligned - wanted.centres) ** 2).sum(1) ** 0.5
    over_time.plot((wanted.t_ns - row.paths[1].t_ns[0]) * 1e-9, error, ".", ms=2)
    over_time.set_xlabel("time [s]")
    over_time.set_ylabel("error [m]")
    figure.suptitle(f"{row.flight}, fault: {row.fault}")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
