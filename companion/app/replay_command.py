"""Replay of a recorded flight through the stages of the daemon: map, recording, report."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from pathlib import Path

from companion.app.progress import Progress
from companion.compute.compute_devices import choose_devices
from companion.config import Config
from companion.config_file import command_shown, shown
from companion.dense.depth_stage import DepthStage
from companion.dense.device_takeover import Devices
from companion.errors import FlightError, StageError
from companion.estimation.localisation import LocalisationStage
from companion.messages import Frame, Message
from companion.products.flight_result import FlightResult, RunFacts
from companion.products.report.write_results import write_results
from companion.products.surroundings import peak_memory_mb, versions
from companion.runtime.gaps import with_gap_warnings
from companion.runtime.paced_replay import PacedFeed
from companion.runtime.pipeline import Pipeline, Sink, in_order_of_time, in_words
from companion.streaming.viewer import FileViewer, LiveViewer
from companion.timing.clock import StageTimes, monotonic_s
from drivers.flight import ENDS_EARLY, Flight
from drivers.open_flight import open_flight
from drivers.telemetry.telemetry_log import TelemetryLog

LEAD_NS = 10_000_000_000
"""Telemetry used from before the first frame."""


def replay(
    flight_path: Path,
    out: Path,
    config: Config,
    *,
    start_s: float | None,
    stop_s: float | None,
    viewer: str,
    paced: bool,
    progress: Progress,
    notify: Callable[[str], None] = lambda remark: None,
) -> FlightResult:
    """Replay a flight into the folder `out`; InputError when it cannot begin.

    `notify` takes remarks: how the telemetry was read, OpenCL devices refused, address of the
    viewer.

    Results so far are written also when it is interrupted or fails on the way. Where only the dense
    map fails, all frames are tracked and written with the cloud so far; then StageError.
    """
    flight = open_flight(flight_path, config.camera, config.telemetry)
    start_ns, stop_ns = _span(flight, start_s, stop_s)
    log = flight.telemetry()
    for remark in log.remarks:
        notify(f"telemetry: {remark}")
    devices = choose_devices(config.opencl, notify) if config.depth.enabled else None
    out.mkdir(parents=True, exist_ok=True)
    times = StageTimes()
    result = FlightResult(out, config.cloud.memory_mb)
    began_s = monotonic_s()
    completed = False
    dropped: dict[str, int] = {}
    with ExitStack() as stack:
        sinks: list[Sink] = [result]
        recording = stack.enter_context(
            FileViewer(config.viewer, flight.camera, out / "flight.rrd", log.origin)
        )
        sinks.append(recording)
        live: LiveViewer | None = None
        if viewer != "none":
            live = stack.enter_context(
                LiveViewer(config.viewer, flight.camera, viewer, origin=log.origin)
            )
            sinks.append(live)
            if live.page:
                notify(f"viewer: open {live.page}")
        depth = _depth_stage(config, flight, devices, times)
        pipeline = Pipeline(
            LocalisationStage(config, flight.camera, times, background=paced),
            depth,
            sinks,
            lossless=not paced,
        )
        try:
            dropped = _run(pipeline, result, flight, log, start_ns, stop_ns, paced, progress)
            completed = True
        finally:
            progress.finish()
            try:
                pipeline.finish()
            finally:
                dropped["depth frames"] = pipeline.n_depth_frames_dropped
                if live is not None:
                    dropped["viewer messages"] = live.n_dropped
                facts = RunFacts(
                    stage_times=times.summary(), wall_s=monotonic_s() - began_s, clock=log.clock,
                    origin=log.origin if _has_origin(result) else None,
                    device=devices.described if devices else "none (depth.enabled = false)",
                    config=shown(config), versions=versions(),
                    command=command_shown(sys.argv),
                    peak_memory_mb=peak_memory_mb(), camera=flight.camera,
                    n_frames_total=flight.n_frames_between(start_ns, stop_ns),
                    completed=completed, dropped=dropped, rates_hz=dict(log.rates_hz),
                )  # fmt: skip
                write_results(out, result, facts, config.cloud.voxel_m)
                result.close()
        if devices is not None and devices.failures:
            notify(f"dense map: {devices.described}")
        if pipeline.depth_fault is not None:
            raise StageError(
                f"the dense map failed after {result.n_depth_maps} depth maps: "
                f"{in_words(pipeline.depth_fault)}; path, report and the cloud so far are in {out}"
            ) from pipeline.depth_fault
    return result


def _span(flight: Flight, start_s: float | None, stop_s: float | None) -> tuple[int, int]:
    start_ns = flight.start_ns + int((start_s or 0.0) * 1e9)
    stop_ns = flight.stop_ns if stop_s is None else flight.start_ns + int(stop_s * 1e9)
    short = next((w for w in flight.warnings if w.what == ENDS_EARLY), None)
    if short is not None and (stop_s is None or stop_ns > flight.stop_ns):
        there_s = (flight.stop_ns - flight.start_ns) * 1e-9
        raise FlightError(
            f"{flight.path}: {short.what}: {short.detail}; "
            f"--stop {int(there_s * 10) / 10:g} replays what is there"
        )
    if flight.n_frames_between(start_ns, stop_ns) == 0:
        length_s = (flight.stop_ns - flight.start_ns) * 1e-9
        raise FlightError(
            f"{flight.path}: no frame between --start and --stop; it is {length_s:.1f} s long"
        )
    return start_ns, stop_ns


def _depth_stage(
    config: Config, flight: Flight, devices: Devices | None, times: StageTimes
) -> DepthStage | None:
    if devices is None:
        return None
    return DepthStage(config.depth, config.cloud, flight.camera, devices, times)


def _run(
    pipeline: Pipeline, result: FlightResult, flight: Flight, log: TelemetryLog,
    start_ns: int, stop_ns: int, paced: bool, progress: Progress,
) -> dict[str, int]:  # fmt: skip
    for warning in (*flight.warnings, *log.warnings):
        pipeline.feed(warning)
    samples = [s for s in log.samples if start_ns - LEAD_NS <= s.t_ns <= stop_ns]
    feed: Iterable[Message] = with_gap_warnings(
        in_order_of_time(samples, flight.frames(start_ns, stop_ns))
    )
    player = PacedFeed(feed) if paced else None
    progress.start(flight.n_frames_between(start_ns, stop_ns))
    done = 0
    for message in player or feed:
        pipeline.feed(message)
        if isinstance(message, Frame):
            done += 1
            progress.update(done, pipeline.state, result.n_points)
    return {"frames": player.n_dropped if player else 0}


def _has_origin(result: FlightResult) -> bool:
    return result.georeference is not None and result.georeference.has_origin
