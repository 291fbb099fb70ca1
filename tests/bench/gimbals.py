"""A camera on a gimbal: errors of the body's pose, and what becomes of angles that are wrong.

    python -m tests.bench.gimbals [--seconds 40] [--seeds 3]

Drawn flights of a copter that leans and turns, with the camera fixed and on a gimbal that follows
its heading, is locked to north, or sweeps over the ground; seeds are of the ground and of the noise
of the angles. A row each: frames placed; the first pose of the body; error of its place without
the mean (RMS) and of its attitude (95th percentile). Then, while it follows, lies that begin after
half of the flight: what was said and after how long, and the largest errors of poses from then on.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

from companion.estimation.attitude.attitude_verdict import GIMBAL_DISAGREES
from companion.estimation.gimbal.gimbal_head import GIMBAL_SILENT
from companion.telemetry import GimbalSample
from tests.support.flights.gimbal_flight import (
    Lie,
    Mode,
    body_errors,
    fly_fixed,
    fly_with_gimbal,
    turned,
)
from tests.support.flights.rendered_flight import START_NS, Flown

DRIFT_DEG_S, STEP_DEG = 2.0, 20.0


def after_s(t_ns: int) -> float:
    return (t_ns - START_NS) * 1e-9


def row(name: str, flights: Sequence[Flown]) -> str:
    """Of all flights of a kind: the worst first pose, the errors of all poses."""
    known = [[o for o in each.odometry if o.world_from_body is not None] for each in flights]
    errors = [body_errors(each) for each in known]
    away_m = np.concatenate([away for away, _ in errors])
    turn_deg = np.degrees(np.concatenate([turn for _, turn in errors]))
    return (
        f"| {name} | {min(each.placed_share for each in flights):.1%}"
        f" | {max(after_s(each[0].t_ns) for each in known):.1f} s"
        f" | {np.sqrt((away_m**2).sum(1).mean()):.2f} m | {np.percentile(turn_deg, 95):.1f}° |"
    )


def lies(begin_s: float) -> dict[str, Lie]:
    """What is told from a time on."""

    def silent(now_s: float, sample: GimbalSample) -> GimbalSample | None:
        return sample if now_s < begin_s else None

    def drifting(now_s: float, sample: GimbalSample) -> GimbalSample:
        return turned(sample, np.radians(DRIFT_DEG_S) * max(0.0, now_s - begin_s))

    def stepped(now_s: float, sample: GimbalSample) -> GimbalSample:
        return turned(sample, np.radians(STEP_DEG) * (now_s >= begin_s))

    def frozen(now_s: float, sample: GimbalSample) -> GimbalSample:
        last.update({} if now_s >= begin_s else {"it": sample})
        return GimbalSample(sample.t_ns, last["it"].level_from_head, sample.yaw_from_north)

    last: dict[str, GimbalSample] = {}
    return {
        "silent": silent,
        f"yaw drifts by {DRIFT_DEG_S:.0f}°/s": drifting,
        f"yaw off by {STEP_DEG:.0f}°": stepped,
        "frozen, while it sweeps": frozen,
    }


def lie_row(name: str, flown: Flown, begin_s: float) -> str:
    """When it was said, and how far poses were off from its begin to the end."""
    said = [
        (after_s(t_ns) - begin_s, what) for t_ns, what in flown.warned
        if what in (GIMBAL_DISAGREES, GIMBAL_SILENT) and after_s(t_ns) >= begin_s
    ]  # fmt: skip
    words = "; ".join(f"{what}, {s:.1f} s" for s, what in said) or "-"
    known = [o for o in flown.odometry if o.world_from_body is not None]
    late = np.array([after_s(o.t_ns) >= begin_s for o in known])
    away_m, turn_rad = body_errors(known)
    if not late.any():
        return f"| {name} | {words} | - | - | 0 |"
    most_m = np.linalg.norm(away_m[late], axis=1).max()
    most_deg = np.degrees(turn_rad[late].max())
    return f"| {name} | {words} | {most_m:.2f} m | {most_deg:.1f}° | {late.sum()} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--seeds", type=int, default=3)
    given = parser.parse_args()
    seeds = range(1, given.seeds + 1)
    print("| camera | placed | first pose | place | attitude |\n|---|---|---|---|---|")
    print(row("fixed", [fly_fixed(given.seconds, seed) for seed in seeds]), flush=True)
    for mode in Mode:
        flights = [fly_with_gimbal(mode, given.seconds, seed=seed) for seed in seeds]
        print(row(mode.value, flights), flush=True)
    begin_s = given.seconds / 2
    print("\n| lie | said, after | place off at most | attitude | poses |\n|---|---|---|---|---|")
    for name, lie in lies(begin_s).items():
        mode = Mode.SWEEP if "sweeps" in name else Mode.FOLLOW
        flown = fly_with_gimbal(mode, given.seconds, lie)
        print(lie_row(name, flown, begin_s), flush=True)


if __name__ == "__main__":
    main()
