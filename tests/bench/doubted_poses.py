"""Effect of faulty satellites on the poses sent, with and without their doubt.

    python -m tests.bench.doubted_poses FLIGHT…

A flight is replayed as it is, and with satellites that are pulled, jump or freeze from its middle
on, which the autopilot's own estimate follows. Of each: the largest distance of the poses sent from
those of the flight as it is, and the last.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from companion.app.replay.poses_sent import PosesSent
from companion.config import Config
from companion.config_file import load_config
from companion.estimation.localisation import LocalisationStage
from companion.estimation.satellites.satellite_watch import SatelliteWatch
from companion.geometry.transforms import Array
from companion.runtime.in_order import in_order_of_time
from companion.telemetry import PositionSample, Telemetry
from companion.timing.clock import StageTimes
from drivers.flight import Flight
from drivers.open_flight import open_flight
from tests.bench.accuracy.injected_faults import FAULTS, NO_FAULT, Span


class _Believing(SatelliteWatch):
    """Doubts nothing."""

    def may_use(self, sample: PositionSample, velocity_unproved: bool = False) -> bool:
        return True


def sent(flight: Flight, config: Config, samples: list[Telemetry], doubt: bool) -> dict[int, Array]:
    """Places of the poses sent, by their times."""
    stage, poses = LocalisationStage(config, flight.camera, StageTimes()), PosesSent(config)
    if not doubt:
        stage._telemetry._satellites = _Believing(flight.camera.camera_from_body)
    for message in in_order_of_time(samples, flight.frames(flight.start_ns, flight.stop_ns)):
        poses.take(message)
        for out in stage.step(message):
            poses.take(out)
    return {each.t_ns: each.world_from_body.translation for each in poses.poses}


def main() -> None:
    """Print a row for each flight and fault."""
    config = load_config(None, ["feedback.mode=odometry"])
    for path in map(Path, sys.argv[1:]):
        flight = open_flight(path, config.camera, config.telemetry)
        samples = list(flight.telemetry().samples)
        span = Span(flight.start_ns, flight.stop_ns)
        as_it_is = sent(flight, config, samples, doubt=True)
        for fault in (NO_FAULT, *(f for f in FAULTS if f.name.startswith("satellites"))):
            for doubt in (True, False):
                found = sent(flight, config, fault.telemetry(samples, span), doubt)
                off_m = [
                    float(np.linalg.norm(found[t] - as_it_is[t])) for t in found if t in as_it_is
                ]
                print(
                    f"| {path.name} | {fault.name} | {'doubted' if doubt else 'believed'} | "
                    f"{max(off_m):.2f} m | {off_m[-1]:.2f} m |", flush=True,
                )  # fmt: skip


if __name__ == "__main__":
    main()
