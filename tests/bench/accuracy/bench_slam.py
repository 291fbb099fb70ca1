"""Tracking of recorded flights measured against ground truth, without dense mapping.

A flight's truth is `truth/world_from_camera.tum` in its folder, or what its format has. Everything
runs in lockstep, so that errors are the same in each run; times are not.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np
from numpy.typing import NDArray

from companion.app.progress import Progress
from companion.config import Config
from companion.errors import FlightError
from companion.estimation.localisation import LocalisationStage
from companion.geometry.transforms import (
    Array,
    Pose,
    interpolate_rotation,
    rotation_from_quaternion,
)
from companion.messages import Frame, Odometry, Track, TrackState
from companion.products.flight_result import FlightResult
from companion.runtime.in_order import in_order_of_time
from companion.runtime.peak_memory import peak_memory_mb
from companion.timing.clock import StageTimes
from drivers.flight import Flight, TruePose
from drivers.open_flight import open_flight
from tests.bench.accuracy.injected_faults import FAULTS, NO_FAULT, Fault, Span
from tests.bench.accuracy.path_errors import Path, path_errors
from tests.bench.accuracy.slam_tables import BenchRow, write_bench

LEAD_NS = 10_000_000_000
FRAME_PARTS = ("features", "tracking", "initialising")
"""Work that a frame waits for; the rest runs in the background in flight."""
NEES_NS = 10_000_000_000
STEP_NS = 500_000_000
"""Longest interval between consecutive odometry poses."""
TRUTH_GAP_NS = 100_000_000
"""Longest gap in the truth over which it is interpolated: motion capture drops single samples."""


@dataclass(frozen=True, slots=True)
class _Cost:
    """Work per frame, and the median per keyframe, milliseconds."""

    frame_ms: Array
    mapping_ms_median: float

    def growth(self) -> float:
        fifth = max(len(self.frame_ms) // 5, 1)
        early, late = self.frame_ms[fifth : 2 * fifth], self.frame_ms[-fifth:]
        return float(np.median(late) / max(np.median(early), 1e-9)) if len(early) else 1.0


class _Listener:
    """Sink that keeps the tracks and odometry of a run."""

    def __init__(self) -> None:
        self.result = FlightResult()
        self.live: list[tuple[int, Track]] = []
        self.odometry: list[Odometry] = []

    def take(self, message: object) -> None:
        if isinstance(message, Track) and not message.backfilled:
            self.live.append((message.t_ns, message))
        elif isinstance(message, Odometry):
            self.odometry.append(message)


def bench_slam(
    flights: Sequence[FilePath],
    config: Config,
    out: FilePath | None,
    *,
    faults: bool,
    above_m: float | None,
    progress: Progress,
) -> list[BenchRow]:
    """Track each flight, or each under every fault; FlightError where one has no truth.

    With `above_m` only frames truly higher than that above the world's origin are expected to be
    tracked.
    """
    rows = []
    for path in flights:
        truth = _truth(open_flight(path, config.camera, config.telemetry, config.mount))
        for fault in FAULTS if faults else (NO_FAULT,):
            rows.append(_run(path, truth, config, fault, above_m, progress))
    if out is not None:
        write_bench(out, rows)
    return rows


def _truth(flight: Flight) -> Path:
    path = flight.path / "truth" / "world_from_camera.tum"
    if path.exists():
        return _path_of_rows(np.loadtxt(path, comments="#", ndmin=2))
    known = sorted(flight.truth(), key=lambda each: each.t_ns)
    if not known:
        raise FlightError(f"{path}: not there; a bench needs the true path")
    return _at_frames(known, flight.times_ns)


def _at_frames(known: Sequence[TruePose], frames_ns: Sequence[int]) -> Path:
    """True poses at the times of the frames, of truth measured at times of its own."""
    times_ns = [each.t_ns for each in known]
    out: list[tuple[int, Pose]] = []
    for t_ns in frames_ns:
        after = bisect_left(times_ns, t_ns)
        if after < len(known) and times_ns[after] == t_ns:
            out.append((t_ns, known[after].world_from_camera))
        elif 0 < after < len(known) and times_ns[after] - times_ns[after - 1] <= TRUTH_GAP_NS:
            a, b = known[after - 1], known[after]
            fraction = (t_ns - a.t_ns) / (b.t_ns - a.t_ns)
            out.append((t_ns, _between(a.world_from_camera, b.world_from_camera, fraction)))
    return _path_of(
        [t_ns for t_ns, _ in out], [(pose.rotation, pose.translation) for _, pose in out]
    )


def _between(a: Pose, b: Pose, fraction: float) -> Pose:
    return Pose(
        interpolate_rotation(a.rotation, b.rotation, fraction),
        (1.0 - fraction) * a.translation + fraction * b.translation,
    )


def _path_of_rows(rows: Array) -> Path:
    rotations = np.stack([rotation_from_quaternion(q[[3, 0, 1, 2]]) for q in rows[:, 4:8]])
    return Path(np.round(rows[:, 0] * 1e9), rows[:, 1:4], rotations)


def _run(
    path: FilePath, truth: Path, config: Config, fault: Fault, above_m: float | None,
    progress: Progress,
) -> BenchRow:  # fmt: skip
    flight = open_flight(path, config.camera, config.telemetry, config.mount)
    span = Span(flight.start_ns, flight.stop_ns)
    samples = [s for s in flight.telemetry().samples if s.t_ns >= span.start_ns - LEAD_NS]
    messages = in_order_of_time(
        fault.telemetry(samples, span), fault.pictures(flight.frames(), span)
    )
    times, listener = StageTimes(), _Listener()
    stage = LocalisationStage(config, flight.camera, times)
    frame_t_ns: list[int] = []
    frame_ms: list[float] = []
    done_ms = 0.0
    progress.start(flight.n_frames)
    for message in messages:
        listener.result.take(message)
        for out in stage.step(message):
            listener.result.take(out)
            listener.take(out)
        if isinstance(message, Frame):
            frame_t_ns.append(message.t_ns)
            before_ms, done_ms = done_ms, sum(times.total_ms(part) for part in FRAME_PARTS)
            frame_ms.append(done_ms - before_ms)
            progress.update(len(frame_t_ns), stage.state.value, 0)
    for out in stage.finish():
        listener.result.take(out)
    progress.finish()
    cost = _Cost(np.array(frame_ms), times.summary().get("mapping", {}).get("p50_ms", 0.0))
    mount = flight.camera.camera_from_body.inverse()
    return _row(path.name, truth, fault, span, above_m, frame_t_ns, listener, cost, stage, mount)


def _row(
    name: str, truth: Path, fault: Fault, span: Span, above_m: float | None,
    frame_t_ns: list[int], listener: _Listener, cost: _Cost, stage: LocalisationStage,
    mount: Pose,
) -> BenchRow:  # fmt: skip
    poses = listener.result.poses()
    estimate = _path_of(
        [p.t_ns for p in poses],
        [(p.world_from_camera.rotation, p.world_from_camera.translation) for p in poses],
    )
    due = _due(np.array(frame_t_ns), truth, fault.dropout_ns(span), above_m)
    known = np.asarray(np.isin(due, estimate.t_ns), bool)
    live = [(t, k.map_from_camera) for t, k in listener.live if k.map_from_camera is not None]
    live_errors = path_errors(
        _path_of([t for t, _ in live], [(p.rotation, p.translation) for _, p in live]), truth
    )
    update = listener.result.update
    found = listener.result.georeference
    return BenchRow(
        name, fault.name, len(frame_t_ns), round(float(known.mean()), 4) if len(due) else 0.0,
        path_errors(estimate, truth), live_errors.ate_sim3_m if live_errors else None,
        _worst_step(listener.odometry, truth, mount), _nees(listener.odometry, truth, mount),
        _nees_yaw(listener.odometry, truth, mount),
        max((o.reset_counter for o in listener.odometry), default=0),
        _longest_gap_s(due, known),
        sum(o.state is TrackState.DEAD_RECKONING for o in listener.odometry),
        update.n_keyframes if update is not None else 0, stage.n_segments, stage.n_loops,
        found.method if found is not None else "none",
        round(float(np.median(cost.frame_ms)), 2),
        round(float(np.percentile(cost.frame_ms, 95)), 2),
        round(cost.mapping_ms_median, 1), round(cost.growth(), 3),
        round(peak_memory_mb(), 1), tuple(sorted(listener.result.warnings)),
        (estimate, truth),
    )  # fmt: skip


def _path_of(t_ns: Sequence[int], poses: Sequence[tuple[Array, Array]]) -> Path:
    if not poses:
        return Path(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    rotations, centres = zip(*poses, strict=True)
    return Path(np.array(t_ns, np.float64), np.stack(centres), np.stack(rotations))


def _due(
    t_ns: Array, truth: Path, dropout_ns: tuple[int, int] | None, above_m: float | None
) -> Array:
    """Times of the frames that should be tracked."""
    keep = np.ones(len(t_ns), bool)
    if dropout_ns is not None:
        keep &= (t_ns < dropout_ns[0]) | (t_ns >= dropout_ns[1])
    if above_m is not None:
        height_m = -np.interp(t_ns, truth.t_ns, truth.centres[:, 2])
        keep &= height_m > above_m
    return np.asarray(t_ns[keep], np.float64)


def _longest_gap_s(due_ns: Array, known: NDArray[np.bool_]) -> float:
    """Longest run of expected frames without a pose, from its first to its end."""
    longest, since = 0.0, None
    for t_ns, there in zip(due_ns, known, strict=True):
        if there:
            since = None
        else:
            since = t_ns if since is None else since
            longest = max(longest, (t_ns - since) * 1e-9)
    return round(longest, 3)


def _nees(odometry: list[Odometry], truth: Path, body_from_camera: Pose) -> float | None:
    """NEES of the displacement over ten seconds, in the true attitude's frame at its start."""
    known = [o for o in odometry if o.world_from_body is not None]
    times = np.array([o.t_ns for o in known])
    ratios = []
    for start in known:
        j = int(np.searchsorted(times, start.t_ns + NEES_NS))
        if j >= len(known) or known[j].reset_counter != start.reset_counter:
            continue
        error = _step_error(start, known[j], truth, body_from_camera)
        variance = known[j].sigma_position_m ** 2
        ratios.append(float((error**2).sum()) / (3.0 * variance))
    return round(float(np.mean(ratios)), 2) if ratios else None


def _nees_yaw(odometry: list[Odometry], truth: Path, body_from_camera: Pose) -> float | None:
    """NEES of the heading of every pose against the truth."""
    ratios = []
    for o in odometry:
        if o.world_from_body is None:
            continue
        camera = (o.world_from_body @ body_from_camera).rotation
        off = camera @ truth.rotations[int(np.abs(truth.t_ns - o.t_ns).argmin())].T
        ratios.append(float(np.arctan2(off[1, 0], off[0, 0])) ** 2 / o.sigma_yaw_rad**2)
    return round(float(np.mean(ratios)), 3) if ratios else None


def _step_error(start: Odometry, end: Odometry, truth: Path, body_from_camera: Pose) -> Array:
    """Error (3,) of the camera's displacement, in its attitude at the start."""
    assert start.world_from_body is not None and end.world_from_body is not None
    a, b = start.world_from_body @ body_from_camera, end.world_from_body @ body_from_camera
    i, j = (int(np.abs(truth.t_ns - o.t_ns).argmin()) for o in (start, end))
    step = a.rotation.T @ (b.translation - a.translation)
    true = truth.rotations[i].T @ (truth.centres[j] - truth.centres[i])
    return np.asarray(step - true, np.float64)


def _worst_step(odometry: list[Odometry], truth: Path, body_from_camera: Pose) -> float | None:
    """Largest RPE between consecutive odometry poses without a reset between them, metres."""
    worst: float | None = None
    before: Odometry | None = None
    for now in odometry:
        if now.world_from_body is None:
            continue
        if (
            before is not None and now.reset_counter == before.reset_counter
            and now.t_ns - before.t_ns < STEP_NS
        ):  # fmt: skip
            worst = max(
                worst or 0.0,
                float(np.linalg.norm(_step_error(before, now, truth, body_from_camera))),
            )
        before = now
    return worst
