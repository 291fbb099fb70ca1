"""Error of dead reckoning while the camera is blind, on flights with ground truth.

    python -m tests.bench.blind FLIGHT… [--seconds 2,5] [--first-s 20] [--every-s 15]
        [--set SECTION.KEY=VALUE ...]

Images are black for so long, again and again. For every span one line: what was given out while
blind (share of frames with a pose, its error and what was stated at the end), when tracking went
on, and by how much the displacement across the span, to the pose a second after the next that was
tracked, is off. Errors are of displacements since the last tracked frame, with the heading aligned
over the seconds before it; scale errors are in them.
"""

from __future__ import annotations

import argparse
import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from companion.app.replay.poses_sent import PosesSent
from companion.config_file import load_config
from companion.estimation.localisation import LocalisationStage
from companion.geometry.transforms import Array, rotation_from_quaternion
from companion.messages import Frame, Odometry, TrackState
from companion.runtime.in_order import in_order_of_time
from drivers.open_flight import open_flight

SETTLED_S, ALIGNED_S = 1.0, 15.0


def true_places(flight: Path) -> tuple[Array, Array]:
    """Times (N,), s, and true places of the body (N, 3), local NED, metres."""
    truth = np.loadtxt(flight / "truth" / "world_from_camera.tum", ndmin=2)
    body_from_camera = np.array(
        json.loads((flight / "camera.json").read_text())["body_from_camera"]
    )
    lever = body_from_camera[:3, :3].T @ body_from_camera[:3, 3]
    turns = np.stack([rotation_from_quaternion(q[[3, 0, 1, 2]]) for q in truth[:, 4:8]])
    return truth[:, 0], truth[:, 1:4] - turns @ lever


def heading(found: Array, true: Array) -> Array:
    """Rotation about the vertical (3, 3) that brings places to the true ones."""
    a, b = (found - found.mean(0))[:, :2], (true - true.mean(0))[:, :2]
    yaw = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def fly(path: Path, seconds: float, options: argparse.Namespace) -> None:
    """One flight with blind spans of a length."""
    config = load_config(None, options.set)
    flight = open_flight(path, config.camera, config.telemetry)
    stage = LocalisationStage(config, flight.camera, lambda _: nullcontext())
    sent, seen = PosesSent(config), list[Odometry]()

    def is_blind(t_s: float) -> bool:
        since_s = t_s - options.first_s
        return bool(since_s >= 0 and since_s % options.every_s < seconds)

    samples = [s for s in flight.telemetry().samples if s.t_ns > flight.start_ns - 10**10]
    for message in in_order_of_time(samples, flight.frames()):
        given: Any = message
        if isinstance(message, Frame) and is_blind((message.t_ns - flight.start_ns) * 1e-9):
            given = replace(message, grey=np.zeros_like(message.grey))
        sent.take(given)
        for out in stage.step(given):
            if isinstance(out, Odometry):
                sent.take(out)
                seen.append(out)
    report(path, seconds, flight.start_ns, seen, sent, is_blind)


def report(
    path: Path, seconds: float, start_ns: int, seen: list[Odometry], sent: PosesSent, is_blind: Any
) -> None:
    """The lines."""
    t_true, true = true_places(path)

    def true_at(t_ns: Array) -> Array:
        return np.stack([np.interp(t_ns * 1e-9, t_true, true[:, k]) for k in range(3)], -1)

    posed = [o for o in seen if o.world_from_body is not None]
    t_ns = np.array([o.t_ns for o in posed])
    found = np.stack([o.world_from_body.translation for o in posed if o.world_from_body])
    t_s = (t_ns - start_ns) * 1e-9
    tracked = np.array([o.state is TrackState.TRACKING for o in posed])
    blind = np.array([is_blind(t) for t in t_s])
    all_s = np.array([(o.t_ns - start_ns) * 1e-9 for o in seen])
    all_blind = np.array([is_blind(t) for t in all_s])
    sent_s = np.array([(p.t_ns - start_ns) * 1e-9 for p in sent.poses])
    way_m = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(true, axis=0), axis=1))]
    for first in np.flatnonzero(all_blind & ~np.r_[False, all_blind[:-1]]):
        begins_s = all_s[first]
        before = np.flatnonzero(tracked & (t_s < begins_s))
        after = np.flatnonzero(tracked & (t_s > begins_s + seconds))
        if not len(before) or not len(after):
            continue
        last, again = before[-1], after[0]
        aligned = before[t_s[before] > t_s[last] - ALIGNED_S]
        turn = heading(found[aligned], true_at(t_ns[aligned]))
        off_m = found @ turn.T - true_at(t_ns)
        settled = after[np.searchsorted(t_s[after], t_s[again] + SETTLED_S, "right") - 1]
        inside = np.flatnonzero(blind & (t_s >= begins_s) & (t_s < begins_s + seconds))
        n_blind = np.count_nonzero((all_s >= begins_s) & (all_s < begins_s + seconds))
        n_sent = np.count_nonzero((sent_s >= begins_s) & (sent_s < begins_s + seconds))
        flown_m = float(np.interp([t_s[again]], t_true - start_ns * 1e-9, way_m)[0])
        span_m = flown_m - float(np.interp([t_s[last]], t_true - start_ns * 1e-9, way_m)[0])
        reached = "no pose"
        if len(inside):
            end = inside[-1]
            error_m = float(np.linalg.norm(off_m[end] - off_m[last]))
            reached = (
                f"{100 * len(inside) / n_blind:.0f} % with a pose, to {t_s[end] - begins_s:.1f} s, "
                f"off by {error_m:.2f} m (sigma {posed[end].sigma_position_m:.2f})"
            )
        across_m = float(np.linalg.norm(off_m[settled] - off_m[last]))
        resets = posed[settled].reset_counter - posed[last].reset_counter
        print(
            f"{path.name} {begins_s:5.1f} s blind for {seconds:g} s: {reached}, {n_sent} sent; "
            f"tracked {t_s[again] - begins_s - seconds:.1f} s after, {resets} resets; "
            f"{across_m:.2f} m off after {span_m:.1f} m, {flown_m:.0f} m flown",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("flights", nargs="+", type=Path)
    parser.add_argument("--seconds", default="2,5")
    parser.add_argument("--first-s", type=float, default=20.0)
    parser.add_argument("--every-s", type=float, default=15.0)
    parser.add_argument("--set", action="append", default=[])
    options = parser.parse_args()
    for path in options.flights:
        for seconds in options.seconds.split(","):
            fly(path, float(seconds), options)


if __name__ == "__main__":
    main()
