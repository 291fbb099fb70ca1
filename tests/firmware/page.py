"""The page of all trials: a table of figures, and for each trial its path, heights and texts."""

from __future__ import annotations

import csv
import html
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from companion.geometry.transforms import Array
from tests.firmware.ground import messages_heard

STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;max-width:1080px;margin:2em auto;padding:0 1em}"
    "table{border-collapse:collapse;width:100%}td,th{padding:.2em .6em;text-align:left;"
    "border-bottom:1px solid #ddd;vertical-align:top}.miss{background:#fde0dc}"
    ".ok{background:#e3f4e1}pre{background:#f6f6f6;padding:1em;overflow:auto;max-height:22em}"
    "svg{max-width:100%;height:auto}td.n{text-align:right;font-variant-numeric:tabular-nums}"
)
FARTHEST_M = 1e4
"""PX4 tells places 5000 km away until it has an origin."""
TRUE, BELIEVED, SENT = "#1f1f1f", "#2b7bba", "#d95f02"


def write_page(out: Path) -> Path:
    """`out`/index.html, from `out`/runs.json and the trials' folders."""
    runs = json.loads((out / "runs.json").read_text())
    parts = [_summary(runs)]
    for run in reversed(runs):
        parts.append(_section(out, run))
    page = out / "index.html"
    page.write_text(
        "<!doctype html><html lang='en'><meta charset='utf-8'><title>Firmware trials</title>"
        f"<style>{STYLE}</style><h1>Flown by the firmwares, in their simulators</h1>"
        + "\n".join(parts)
    )
    return page


def _summary(runs: list[dict[str, Any]]) -> str:
    """One row a figure and firmware, over all runs: how often it held, and the worst."""
    found: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for run in runs:
        for each in run["figures"]:
            if each["at_most"] is not None:
                key = run["firmware"], run["experiment"], each["name"]
                found.setdefault(key, []).append(each)
    rows = []
    for (firmware, experiment, name), figures in sorted(found.items()):
        held = sum(each["holds"] for each in figures)
        values = [each["value"] for each in figures if each["value"] is not None]
        kind = "ok" if held == len(figures) else "miss"
        median = f"{np.median(values):.2f}" if values else "none"
        worst = f"{max(values):.2f}" if len(values) == len(figures) else "none"
        rows.append(
            f"<tr class='{kind}'><td>{firmware}</td><td>{experiment}</td><td>{html.escape(name)}"
            f"</td><td class='n'>{figures[0]['at_most']:g}</td><td class='n'>{median}</td>"
            f"<td class='n'>{worst}</td><td>{figures[0]['unit']}</td>"
            f"<td class='n'>{held} of {len(figures)}</td></tr>"
        )
    head = "firmware experiment figure asked median worst unit held".split()
    cells = "".join(f"<th>{each}</th>" for each in head)
    return f"<table><tr>{cells}</tr>{''.join(rows)}</table>"


def _section(out: Path, run: dict[str, Any]) -> str:
    folder = out / run["folder"]
    told = f"{run['version']}, seed {run['seed']}, wind {run['wind_m_s']:g} m/s, {run['look']}"
    lines = []
    for each in run["figures"]:
        kind = {None: "", True: "ok", False: "miss"}[each["holds"]]
        value = "none" if each["value"] is None else f"{each['value']:.3f}"
        asked = "" if each["at_most"] is None else f"{each['at_most']:g}"
        lines.append(
            f"<tr class='{kind}'><td>{html.escape(each['name'])}</td><td class='n'>{value}</td>"
            f"<td>{each['unit']}</td><td class='n'>{asked}</td><td>{html.escape(each['note'])}"
            "</td></tr>"
        )
    events = folder / "events.txt"
    said = html.escape(events.read_text()) if events.exists() else ""
    return (
        f"<h2>{html.escape(run['folder'])}</h2><p>{html.escape(told)}</p>{_plots(folder)}"
        f"<table>{''.join(lines)}</table><details><summary>What happened</summary><pre>{said}"
        "</pre></details>"
    )


def _plots(folder: Path) -> str:
    """Plan, and each coordinate over time: true, believed by the autopilot, sent by us."""
    if not (folder / "truth.csv").exists():
        return ""
    with (folder / "truth.csv").open() as lines:
        true = np.array([[float(each) for each in row] for row in list(csv.reader(lines))[1:]])
    if not len(true):
        return ""
    began_s = true[0, 0]
    series = [("true", TRUE, true[:, :4])]
    for name, colour, kind in (
        ("autopilot", BELIEVED, "LOCAL_POSITION_NED"),
        ("sent", SENT, "COMPANION/ODOMETRY"),
    ):
        heard = [
            (t_s, m.x, m.y, m.z)
            for t_s, m in messages_heard(folder / "ground.tlog", kind)
            if max(abs(m.x), abs(m.y)) < FARTHEST_M
        ]
        series.append((name, colour, np.array(heard, float).reshape(-1, 4)))
    figure = Figure(figsize=(11, 5.2), layout="constrained")
    grid = figure.add_gridspec(3, 2)
    plan, *rest = (
        figure.add_subplot(grid[where]) for where in ((slice(None), 0), (0, 1), (1, 1), (2, 1))
    )
    for name, colour, rows in series:
        if not len(rows):
            continue
        broken = _with_gaps(rows)
        plan.plot(broken[:, 2], broken[:, 1], color=colour, lw=1, label=name)
        for axes, column in zip(rest, (1, 2, 3), strict=True):
            sign = -1 if column == 3 else 1
            axes.plot(broken[:, 0] - began_s, sign * broken[:, column], color=colour, lw=1)
    plan.set_aspect("equal", "datalim")
    plan.set_xlabel("east, m")
    plan.set_ylabel("north, m")
    plan.legend(frameon=False)
    for axes, label in zip(rest, ("north, m", "east, m", "height, m"), strict=True):
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    plan.grid(alpha=0.3)
    rest[-1].set_xlabel("s")
    svg = io.StringIO()
    figure.savefig(svg, format="svg")
    figure.savefig(folder / "paths.png", dpi=90)
    return svg.getvalue()[svg.getvalue().index("<svg") :]


def _with_gaps(rows: Array, gap_s: float = 0.5) -> Array:
    """Rows with a NaN wherever there were none for a while."""
    gaps = np.flatnonzero(np.diff(rows[:, 0]) > gap_s) + 1
    broken: Array = np.insert(rows, gaps, np.nan, axis=0)
    return broken
