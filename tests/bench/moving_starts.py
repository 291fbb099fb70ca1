"""Maps that begin in fast motion: how far off their first frames are.

    python -m tests.bench.moving_starts [--seeds 3] [--seconds 5] [--set SECTION.KEY=VALUE ...]

Drawn flights of 30 frames/s to 8 m/s and 150 degrees/s from the first frame on, with motion blur
and exact truth. For each half second the largest error, m, of poses as they were tracked, of the
path as it is known in the end, both after the similarity alignment of its second half, and of poses
as sent, with heading and place aligned.
"""

from __future__ import annotations

import argparse

import numpy as np

from companion.geometry.transforms import Array
from tests.bench.accuracy.path_errors import Path
from tests.bench.blind import heading
from tests.support.flights.moving_start import CAMERA, EXPOSURE_S, RATE_HZ, moving_path
from tests.support.flights.rendered_flight import Terrain, fly
from tests.support.flights.scene import leaves
from tests.support.reference.scoring import align

STEP_S = 0.5
Places = list[tuple[int, Array]]
"""Times, ns, and places (3,) of the camera."""


def told(name: str, places: Places, truth: Path, seconds: float, metric: bool) -> str:
    """A line: the largest error in each half second, "-" where there is none."""
    if len(places) < 4:
        return f"  {name}: nothing"
    times_s = (np.array([t_ns for t_ns, _ in places]) - truth.t_ns[0]) * 1e-9
    found = np.stack([place for _, place in places])
    of_frame = np.abs(truth.t_ns[None] - np.array([[t_ns] for t_ns, _ in places])).argmin(1)
    true = truth.centres[of_frame]
    if metric:
        turned = found @ heading(found, true).T
        off = turned - turned.mean(0) - true + true.mean(0)
    else:
        late = times_s >= times_s[-1] / 2
        off = align(found[late], true[late])(found) - true
    errors = np.linalg.norm(off, axis=1)
    steps = []
    for begin_s in np.arange(0.0, seconds, STEP_S):
        inside = (times_s >= begin_s) & (times_s < begin_s + STEP_S)
        steps.append(f"{errors[inside].max():.2f}" if inside.any() else "-")
    return f"  {name} from {times_s[0]:.2f} s: {' '.join(steps)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--set", action="append", default=[])
    given = parser.parse_args()
    for seed in range(1, given.seeds + 1):
        flown = fly(
            CAMERA, moving_path(seed), Terrain(seed, pattern=leaves), given.seconds, RATE_HZ,
            exposure_s=EXPOSURE_S, imu_seed=seed, settings=given.set,
        )  # fmt: skip
        assert flown.truth is not None and CAMERA.body_from_camera is not None
        tracked = [
            (t.t_ns, t.map_from_camera.translation)
            for t in flown.tracks
            if t.map_from_camera is not None and not t.backfilled
        ]
        known = [(p.t_ns, p.world_from_camera.translation) for p in flown.result.poses()]
        sent = [
            (p.t_ns, (p.world_from_body @ CAMERA.body_from_camera).translation)
            for p in flown.sent.poses
            if not p.predicted
        ]
        print(f"seed {seed}; warned of: {', '.join(sorted(set(flown.warnings))) or 'nothing'}")
        print(told("as tracked", tracked, flown.truth, given.seconds, False))
        print(told("in the end", known, flown.truth, given.seconds, False))
        print(told("as sent", sent, flown.truth, given.seconds, True), flush=True)


if __name__ == "__main__":
    main()
