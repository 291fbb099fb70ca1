"""Ten minutes of hovering and return passes: growth of the time per frame and of memory.

    python -m tests.bench.long_flight FLIGHT [--minutes 10] [--hover-s 4] [--rate-hz 10] [--out DIR]

The first half is spent in return passes over a few seconds of the flight, the second over all of
it; in lockstep, without dense depth. Prints a row for each half minute of flight, and writes
long.csv and long.svg if asked. Times are of the processor: tracking with mapping, and tracking
alone.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from time import process_time

import numpy as np
import psutil
from matplotlib.figure import Figure

from companion.config import CameraConfig, Config, TelemetryConfig
from companion.estimation.localisation import LocalisationStage
from companion.messages import Frame, MapUpdate
from companion.timing.clock import StageTimes
from drivers.open_flight import open_flight
from tests.support.flights.return_pass import back_and_forth, reordered

ROW_S = 30.0
PARTS = ("features", "tracking", "initialising")
KEYS = ("t_s", "frame_ms", "all_ms", "keyframes", "retired", "points", "memory_mb", "state")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("flight", type=Path)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--hover-s", type=float, default=4.0)
    parser.add_argument("--hover-at-s", type=float, default=10.0)
    parser.add_argument("--rate-hz", type=float, default=10.0)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()

    flight = open_flight(arguments.flight, CameraConfig(), TelemetryConfig())
    nothing = np.zeros((1, 1, 3), np.uint8)
    frames: list[Frame] = []
    for f in flight.frames():
        if isinstance(f, Frame) and (
            not frames or f.t_ns - frames[-1].t_ns > 0.9e9 / arguments.rate_hz
        ):
            frames.append(Frame(f.seq, f.t_ns, f.grey, nothing))
    each_s = (frames[-1].t_ns - frames[0].t_ns) * 1e-9 / (len(frames) - 1)
    n = int(arguments.minutes * 60 / each_s)
    lead, held = (int(s / each_s) for s in (arguments.hover_at_s, arguments.hover_s))
    order = [*range(lead), *back_and_forth(lead, lead + held, n // 2 - lead)]
    order += back_and_forth(lead, len(frames) - 1, n - len(order))

    times = StageTimes()
    stage = LocalisationStage(Config(), flight.camera, times)
    process = psutil.Process()
    rows: list[dict[str, object]] = []
    frame_ms: list[float] = []
    all_ms: list[float] = []
    update: MapUpdate | None = None
    start_ns, due_s = frames[0].t_ns, ROW_S
    print(" ".join(f"{k:>10}" for k in KEYS))
    for message in reordered(frames, flight.telemetry().samples, order):
        began_s, before_ms = process_time(), sum(times.total_ms(p) for p in PARTS)
        for told in stage.step(message):
            update = told if isinstance(told, MapUpdate) else update
        if not isinstance(message, Frame):
            continue
        all_ms.append(1e3 * (process_time() - began_s))
        frame_ms.append(sum(times.total_ms(p) for p in PARTS) - before_ms)
        t_s = (message.t_ns - start_ns) * 1e-9
        if t_s < due_s or update is None:
            continue
        due_s += ROW_S
        rows.append({
            "t_s": round(t_s), "frame_ms": round(float(np.median(frame_ms)), 1),
            "all_ms": round(float(np.mean(all_ms)), 1), "keyframes": update.n_keyframes,
            "retired": update.n_retired, "points": len(update.points_map),
            "memory_mb": round(process.memory_info().rss / 2**20), "state": stage.state.value,
        })  # fmt: skip
        frame_ms, all_ms = [], []
        print(" ".join(f"{rows[-1][k]!s:>10}" for k in KEYS), flush=True)
    if arguments.out is not None:
        _write(arguments.out, rows)


def _write(out: Path, rows: list[dict[str, object]]) -> None:
    out.mkdir(parents=True, exist_ok=True)
    lines = [",".join(KEYS), *(",".join(str(r[k]) for k in KEYS) for r in rows)]
    (out / "long.csv").write_text("\n".join(lines) + "\n")
    figure = Figure(figsize=(8, 8), layout="constrained")
    shown = ("all_ms", "frame_ms", "keyframes", "points", "memory_mb")
    for axes, key in zip(figure.subplots(len(shown), 1, sharex=True), shown, strict=True):
        axes.plot([r["t_s"] for r in rows], [r[key] for r in rows])
        axes.set_ylabel(key)
        axes.set_ylim(bottom=0)
    figure.savefig(out / "long.svg")


if __name__ == "__main__":
    main()
