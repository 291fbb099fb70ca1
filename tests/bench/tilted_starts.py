"""Time until poses are level after maps initialised with a tilt, on recorded flights.

    python -m tests.bench.tilted_starts FLIGHT… [--tilts 10,20,40] [--seconds 20] [--maps 1]

For every kind of `tests.support.flights.tilted_start` and every tilt one line: when tracking
began, when poses first had a scale, what was told, and until when a pose was tilted by more than
the pose gate allows. Flights are replayed in lockstep up to so many seconds.
"""

from __future__ import annotations

import argparse
from contextlib import nullcontext
from pathlib import Path

import numpy as np

from companion.config import Config
from companion.estimation.attitude.attitude_history import AttitudeHistory
from companion.estimation.gate.pose_rules import MAX_TILT_ERROR_RAD
from companion.estimation.localisation import LocalisationStage
from companion.messages import Frame, Odometry, TrackState, Warned
from companion.runtime.in_order import in_order_of_time
from companion.telemetry import AttitudeSample
from drivers.open_flight import open_flight
from tests.support.flights.tilted_start import KINDS, tilted_starts


def fly(path: Path, kind: str, tilt_deg: float, seconds: float, maps: int) -> str:
    """One replay, in one line."""
    config = Config()
    flight = open_flight(path, config.camera, config.telemetry)
    stop_ns = flight.start_ns + int(seconds * 1e9)
    stage = LocalisationStage(config, flight.camera, lambda _: nullcontext())
    history = AttitudeHistory()
    told, tilts, tracked_s = [], [], None
    samples = [s for s in flight.telemetry().samples if s.t_ns > flight.start_ns - 10**10]
    with tilted_starts(kind, tilt_deg, maps) as begun:
        for message in in_order_of_time(samples, flight.frames()):
            if isinstance(message, Frame) and message.t_ns > stop_ns:
                break
            if isinstance(message, AttitudeSample):
                history.add(message)
            for out in stage.step(message):
                if isinstance(out, Warned):
                    told.append(f"{(out.t_ns - flight.start_ns) * 1e-9:.1f} s {out.what}")
                elif isinstance(out, Odometry):
                    t_s = (out.t_ns - flight.start_ns) * 1e-9
                    if tracked_s is None and out.state is TrackState.TRACKING:
                        tracked_s = t_s
                    attitude = history.at(out.t_ns)
                    if out.world_from_body is not None and attitude is not None:
                        cosine = attitude[2] @ out.world_from_body.rotation[2]
                        tilts.append((t_s, float(np.arccos(np.clip(cosine, -1, 1)))))
    off = [t_s for t_s, tilt in tilts if tilt > MAX_TILT_ERROR_RAD]
    return (
        f"{path.name} {kind} {tilt_deg:g}: {len(begun)} tilted, tracking from {tracked_s}, poses "
        f"from {tilts[0][0] if tilts else None}, tilted until {max(off, default=None)}, at the end "
        f"{np.degrees(tilts[-1][1]) if tilts else np.nan:.1f} degrees; {'; '.join(told)}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("flights", nargs="+", type=Path)
    parser.add_argument("--tilts", default="10,20,40")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--maps", type=int, default=1)
    options = parser.parse_args()
    for path in options.flights:
        for kind in KINDS:
            for tilt in options.tilts.split(","):
                print(fly(path, kind, float(tilt), options.seconds, options.maps), flush=True)


if __name__ == "__main__":
    main()
