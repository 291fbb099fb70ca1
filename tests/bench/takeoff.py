"""Take-off in a closed loop of a drone without GPS that flies by the poses it is sent alone.

    python -m tests.bench.takeoff [SEED ...] [--gusts M_S2] [--set SECTION.KEY=VALUE ...]
        [--true-poses]

Some minutes a seed. A line for each: when the first pose came (arming is at 12 s), the longest
gap without one, how far the place was at most from the one to hold, ten seconds after lift-off and
later, how far poses sent then were from the truth (the rest are gusts), and what odometry went by.
"""

from __future__ import annotations

import argparse
from itertools import groupby

from tests.support.flights.takeoff_loop import DEFAULT, GUSTS_M_S2, take_off


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("seeds", nargs="*", type=int, default=list(range(10)))
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--gusts", type=float, default=GUSTS_M_S2, metavar="M_S2")
    parser.add_argument("--true-poses", action="store_true", help="what the vehicle can do itself")
    options = parser.parse_args()
    print(f"armed at {DEFAULT.armed_s} s, lift-off at {DEFAULT.lift_s} s")
    for seed in options.seeds:
        flown = take_off(
            seed, *options.set, gusts_m_s2=options.gusts, true_poses=options.true_poses
        )
        spans = [f"{state.value} {len(list(run))}" for state, run in groupby(flown.states)]
        level_m, down_m = flown.worst_hold_m
        wrong_level_m, wrong_down_m = flown.worst_pose_m
        print(
            f"{seed}: first pose {flown.first_s:.1f} s, longest gap {flown.longest_gap_s:.2f} s, "
            f"held to {level_m:.2f} m level, {down_m:.2f} m up or down, "
            f"poses off by {wrong_level_m:.2f} and {wrong_down_m:.2f} m, "
            f"{flown.sent[-1].reset_counter if flown.sent else 0} resets; {', '.join(spans)}",
            flush=True,
        )


if __name__ == "__main__":
    main()
