"""What is said, and what is sent, on the way to the limits of tracking.

    python -m tests.bench.envelope_approach [descent fog] [--seeds 1]

As `tests.bench.envelope` flies, with an IMU, for 12 s: down from 8 m to 0.5 m at 4 m/s, and 15 m
high into ground that loses its contrast, from all of it to none. Of each flight: when the first
warning of a limit came, when tracking was lost for the first time, the last pose that was sent by
tracking, and the largest error of poses sent, of the way of the second before each in the body's
attitude at its beginning, in metres and in the standard deviations that were stated.
"""

from __future__ import annotations

import argparse

import numpy as np

from companion.estimation.gate.pose_to_send import PoseToSend
from companion.estimation.odometry.tracking_margin import TOO_FAINT, TOO_FAST, TOO_FEW
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose
from companion.messages import Bytes, TrackState
from tests.bench.envelope import CAMERA, EXPOSURE_S, RATE_HZ, Condition, Seen, path_of
from tests.support.flights.rendered_flight import Flown, PathOf, fly

SECONDS, WAY_NS = 12.0, 1_000_000_000
HIGH_M, LOW_M, AT_M = 8.0, 0.5, 2.0
"""The descent, and the height for which its ground has its detail."""
FROM_S, TO_S = 4.0, 11.0
"""When the limit is approached."""


def share(after_s: float) -> float:
    """Of the way to the limit."""
    return float(np.clip((after_s - FROM_S) / (TO_S - FROM_S), 0.0, 1.0))


def descent(level: PathOf) -> PathOf:
    """A path that goes down."""

    def ned_from_body(after_s: float) -> Pose:
        here = level(after_s)
        height_m = HIGH_M * (LOW_M / HIGH_M) ** share(after_s)
        return Pose(here.rotation, np.array([*here.translation[:2], -height_m]))

    return ned_from_body


class Fog(Seen):
    """Ground that loses its contrast northward."""

    def picture(self, camera: Camera, ned_from_camera: Pose) -> Bytes:
        after_s = ned_from_camera.translation[0] / Condition().speed_m_s + 2.5
        self.contrast = 0.01 ** share(float(after_s))
        return super().picture(camera, ned_from_camera)


def worst(flown: Flown) -> tuple[float, float, float]:
    """The largest error of the last second's way, m and sigmas, and when, s."""
    assert flown.truth is not None
    times_ns, places = flown.truth.t_ns, flown.truth.centres
    since_ns = times_ns - times_ns[0]
    assert CAMERA.body_from_camera is not None
    camera_from_body = CAMERA.body_from_camera.inverse()

    def true(t_ns: int) -> Array:
        return np.array([np.interp(t_ns - times_ns[0], since_ns, places[:, k]) for k in range(3)])

    def body(t_ns: int) -> Array:
        assert flown.truth is not None
        nearest = int(np.abs(times_ns - t_ns).argmin())
        turned: Array = flown.truth.rotations[nearest] @ camera_from_body.rotation
        return turned

    most = (0.0, 0.0, 0.0)
    first: list[PoseToSend] = []
    for pose in flown.sent.poses:
        if first and pose.reset_counter != first[0].reset_counter:
            first.clear()
        first.append(pose)
        while pose.t_ns - first[0].t_ns > WAY_NS:
            first.pop(0)
        begin, begin_ns = first[0].world_from_body, first[0].t_ns
        way = begin.rotation.T @ (pose.world_from_body.translation - begin.translation)
        true_way = body(begin_ns).T @ (true(pose.t_ns) - true(begin_ns))
        off_m = float(np.linalg.norm(way - true_way))
        since_s = (pose.t_ns - flown.frames_ns[0]) * 1e-9
        most = max(most, (off_m, off_m / pose.sigma_position_m, since_s))
    return most


def told(name: str, seed: int, flown: Flown) -> str:
    """A row of the table."""
    begin_ns = flown.frames_ns[0]

    def at(t_ns: int | None) -> str:
        return "-" if t_ns is None else f"{(t_ns - begin_ns) * 1e-9:.1f}"

    limits = {TOO_FAST, TOO_FAINT, TOO_FEW}
    said = next(((t, what) for t, what in flown.warned if what in limits), (None, "-"))
    begun = [k for k, o in enumerate(flown.odometry) if o.state is TrackState.TRACKING]
    later = flown.odometry[begun[0] if begun else 0 :]
    lost_ns = next((o.t_ns for o in later if o.state is not TrackState.TRACKING), None)
    by_tracking = [p.t_ns for p in flown.sent.poses if not p.predicted and p.quality > 1]
    off_m, sigmas, worst_s = worst(flown)
    return (
        f"| {name} | {seed} | {at(said[0])}, {said[1].split(':')[0]} | {at(lost_ns)} "
        f"| {at(max(by_tracking, default=None))} | {off_m:.2f} m, {sigmas:.1f}, {worst_s:.1f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("ways", nargs="*", default=["descent", "fog"])
    parser.add_argument("--seeds", type=int, default=1)
    given = parser.parse_args()
    print("| to | seed | said, s | lost, s | last by tracking, s | worst sent, m, sigmas, s |")
    print("|---|---|---|---|---|---|", flush=True)
    for name in given.ways:
        for seed in range(1, given.seeds + 1):
            low = name == "descent"
            ground = Seen(Condition(AT_M), seed) if low else Fog(Condition(), seed)
            path = path_of(Condition())
            flown = fly(
                CAMERA, descent(path) if low else path, ground, SECONDS, RATE_HZ,
                exposure_s=EXPOSURE_S, imu_seed=seed,
            )  # fmt: skip
            print(told(name, seed, flown), flush=True)


if __name__ == "__main__":
    main()
