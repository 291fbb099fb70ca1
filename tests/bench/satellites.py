"""Verdict on satellites on recorded flights: false words, and how soon faults are said.

    python -m tests.bench.satellites FLIGHT… [--set SECTION.KEY=VALUE ...]

Each flight is tracked once; then positions with faults are compared with that vision. Of a flight
as it is: what is said, and how near to a doubt it came (share of the limit). Of each fault, from
the middle of the flight on: what is said, and after how many seconds.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from companion.config_file import load_config
from companion.estimation.localisation import LocalisationStage
from companion.estimation.satellites.satellite_watch import SIGMAS, SatelliteWatch
from companion.geometry.transforms import Pose
from companion.messages import Georeference, Warned
from companion.runtime.in_order import in_order_of_time
from companion.telemetry import AttitudeSample, PositionSample, PositionSource, Telemetry
from companion.timing.clock import StageTimes
from drivers.open_flight import open_flight
from tests.bench.accuracy.injected_faults import FAULTS, JUMP_M, Fault, Samples, Span

BACK_S = 10.0


class Seen(NamedTuple):
    """A frame: its time, map, pose, the place of the map, and whether tracking may fail."""

    t_ns: int
    map_id: int
    map_from_camera: Pose | None
    placed: Georeference | None
    near_limits: bool


def _watch(stage: LocalisationStage) -> list[Seen]:
    """What the watch gets of each frame, kept as it comes."""
    seen: list[Seen] = []
    take_frame = stage._satellites.take_frame

    def seeing(
        t_ns: int, map_id: int, map_from_camera: Pose | None, placed: Georeference | None,
        near_limits: bool = False,
    ) -> None:  # fmt: skip
        seen.append(Seen(t_ns, map_id, map_from_camera, placed, near_limits))
        take_frame(t_ns, map_id, map_from_camera, placed, near_limits)

    stage._satellites.take_frame = seeing  # type: ignore[method-assign]
    return seen


def _silent(samples: Samples, span: Span) -> Samples:
    return [s for s in samples if not isinstance(s, PositionSample) or s.t_ns < span.fault_ns]


def _back(samples: Samples, span: Span) -> Samples:
    """A jump that ends after a while."""

    def moved(sample: Telemetry) -> Telemetry:
        since_s = 1e-9 * (sample.t_ns - span.fault_ns)
        if not isinstance(sample, PositionSample) or not 0.0 <= since_s < BACK_S:
            return sample
        return replace(sample, position_ned_m=sample.position_ned_m + JUMP_M)

    return [moved(s) for s in samples]


def _pulled_without_velocity(samples: Samples, span: Span) -> Samples:
    (pulled,) = (f for f in FAULTS if f.name == "satellites pulled by 1 m/s")
    return [
        replace(after, velocity_ned_m_s=before.velocity_ned_m_s)
        if isinstance(before, PositionSample) and isinstance(after, PositionSample)
        else after
        for before, after in zip(samples, pulled.telemetry(samples, span), strict=True)
    ]


TRIED = (
    Fault("none"),
    *(f for f in FAULTS if f.name.startswith("satellites")),
    Fault("satellites pulled by 1 m/s, velocity as it was", _pulled_without_velocity),
    Fault("satellites jump by 50 m, back after 10 s", _back),
    Fault("satellites silent", _silent),
)


def watched(
    seen: list[Seen], samples: Samples, camera_from_body: Pose, calibrated: bool = True
) -> tuple[list[Warned], float]:
    """What is said, and the largest change as a share of the limit."""
    watch = SatelliteWatch(camera_from_body, calibrated)
    said: list[Warned] = []
    nearest = 0.0
    poses = iter(seen)
    waiting = next(poses, None)
    for sample in samples:
        while waiting is not None and waiting.t_ns < sample.t_ns:
            watch.take_frame(*waiting)
            waiting = next(poses, None)
        if isinstance(sample, AttitudeSample):
            watch.take_time(sample.t_ns)
        elif isinstance(sample, PositionSample) and sample.source is PositionSource.GPS:
            watch.may_use(sample)
            for change in watch.changes():
                sigmas = np.hypot(*change.horizontal_m) / change.sigma_horizontal_m
                up = abs(change.vertical_m) / change.sigma_vertical_m
                nearest = max(nearest, float(sigmas) / SIGMAS, up / SIGMAS)
        said += watch.warnings()
    return said, nearest


def main() -> None:
    """Print a row for each flight and fault."""
    parser = argparse.ArgumentParser()
    parser.add_argument("flights", nargs="+", type=Path)
    parser.add_argument("--set", action="append", default=[])
    arguments = parser.parse_args()
    config = load_config(None, ["feedback.mode=odometry", *arguments.set])
    for path in arguments.flights:
        flight = open_flight(path, config.camera, config.telemetry)
        samples = list(flight.telemetry().samples)
        stage = LocalisationStage(config, flight.camera, StageTimes())
        seen = _watch(stage)
        frames = flight.frames(flight.start_ns, flight.stop_ns)
        for message in in_order_of_time(samples, frames):
            for _ in stage.step(message):
                pass
        placed = [each.t_ns for each in seen if each.placed is not None]
        if not placed:
            print(f"| {path.name} | no metric map |")
            continue
        camera = flight.camera
        calibrated = camera.body_from_camera is not None and not camera.assumed
        span = Span(placed[0], placed[-1])
        for fault in TRIED:
            said, nearest = watched(
                seen, fault.telemetry(samples, span), camera.camera_from_body, calibrated
            )
            words = "; ".join(
                f"{1e-9 * (each.t_ns - span.fault_ns):.1f} s {each.what} ({each.detail})"
                for each in said
            )
            share = f"{nearest:.2f}" if fault.name == "none" else ""
            print(f"| {path.name} | {fault.name} | {share} | {words or 'nothing'} |", flush=True)


if __name__ == "__main__":
    main()
