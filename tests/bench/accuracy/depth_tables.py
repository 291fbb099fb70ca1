"""Results of `depth`: tables, JSON, and a plot of the curves."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from companion.products.atomic_file import write_atomically
from tests.bench.accuracy.depth_accuracy import Accuracy
from tests.bench.accuracy.depth_results import AsUsed, DepthBench


def tables(bench: DepthBench) -> str:
    """Text tables; shares in percent of the pixels whose truth is known."""
    parts = [
        f"{bench.dataset}: {bench.frames} images taken, {bench.searched} of them searched\n"
        f"{bench.device}",
        _aligned(
            [
                ["", "wall s", "CPU s", "converged", "within 1", "2", "5 %", "all: 1", "2", "5 %"],
                *(
                    [r.name, f"{r.wall_s:.2f}", f"{r.cpu_s:.2f}", *_shares(r.converged),
                     *_shares(r.all_pixels)[1:]]
                    for r in bench.runs
                ),
            ]
        ),
    ]  # fmt: skip
    if bench.speed_up is not None:
        parts.append(f"{bench.speed_up:.1f} times as fast")
    parts.append(_as_used(bench.as_used))
    head = ["frames", "updated", "ms/frame", "converged", "within 1", "2", "5 %"]
    for title, stands in (
        ("companion", bench.after_frames), ("REMODE, one core", bench.serial_after_frames)
    ):  # fmt: skip
        if stands:
            rows = [
                [str(s.frames), _percent(s.still_updated), f"{s.ms_per_frame:.1f}",
                 *_shares(s.converged)]
                for s in stands
            ]  # fmt: skip
            parts.append(title + "\n" + _aligned([head, *rows]))
    rows = [[f"{t.min_zncc:g}", *_shares(t.converged)] for t in bench.thresholds]
    parts.append(_aligned([["min_zncc", "converged", "within 1", "2", "5 %"], *rows]))
    spent = sorted(bench.kernel_ms.items(), key=lambda item: -item[1])
    parts.append(_aligned([["kernel", "ms"], *([name, f"{ms:.1f}"] for name, ms in spent)]))
    return "\n\n".join(parts)


def _as_used(used: AsUsed) -> str:
    title = "as a user runs it: ranges of depth found by itself, all references"
    if used.refused:
        return f"{title}\nnot measured: {used.refused}"
    title += f" ({used.n_references}), {used.wall_s:.2f} s and {used.cpu_s:.2f} CPU s for each"
    if not used.rows:
        return f"{title}\nnone of them has a true depth"
    rows = [["reference", "", "converged", "within 1", "2", "5 %", "all: 1", "2", "5 %"]]
    for name, alone, together in (
        ("alone", "alone_converged", "alone_all"), ("as written", "converged", "all_pixels")
    ):  # fmt: skip
        pairs = [(getattr(r, alone), getattr(r, together)) for r in used.rows]
        shares = [
            (a.estimated, a.within_1, a.within_2, a.within_5, b.within_1, b.within_2, b.within_5)
            for a, b in pairs
        ]
        for r, share in zip(used.rows, shares, strict=True):
            rows.append([str(r.reference), name, *map(_percent, share)])
        if len(shares) > 1:
            means = [sum(column) / len(column) for column in zip(*shares, strict=True)]
            rows.append(["mean", name, *map(_percent, means)])
    return title + "\n" + _aligned(rows)


def as_json(bench: DepthBench) -> str:
    """JSON of all results; null for unknown values."""
    content = asdict(bench)
    return json.dumps({**_finite(content), "speed_up": bench.speed_up}, indent=1, allow_nan=False)


def write_bench(out: Path, bench: DepthBench) -> None:
    """Write depth_bench.json and depth_bench.png into folder `out`."""
    write_atomically(out / "depth_bench.json", as_json(bench).encode())
    figure = Figure(figsize=(11, 3.4), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    for name, stands in (
        ("companion", bench.after_frames), ("REMODE, one core", bench.serial_after_frames)
    ):  # fmt: skip
        if stands:
            n = [s.frames for s in stands]
            left.plot(n, [100 * s.converged.estimated for s in stands], "o-", ms=3, label=name)
            middle.plot(n, [100 * s.all_pixels.within_1 for s in stands], "o-", ms=3, label=name)
            right.plot(n, [s.ms_per_frame for s in stands], "o-", ms=3, label=name)
    for axes, label in (
        (left, "converged, %"), (middle, "all pixels within 1 %, %"), (right, "ms per frame")
    ):  # fmt: skip
        axes.set_xscale("log")
        axes.set_xlabel("frames")
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    right.set_yscale("log")
    left.legend(frameon=False)
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110)
    write_atomically(out / "depth_bench.png", picture.getvalue())


def _shares(a: Accuracy) -> list[str]:
    return [_percent(v) for v in (a.estimated, a.within_1, a.within_2, a.within_5)]


def _percent(share: float) -> str:
    return f"{100 * share:.1f}" if math.isfinite(share) else "-"


def _aligned(rows: Sequence[Sequence[str]]) -> str:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(v) for key, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    return value
