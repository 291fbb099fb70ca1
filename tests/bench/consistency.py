"""How honest the standard deviations of poses as sent are, on flights with ground truth.

    python -m tests.bench.consistency FLIGHT… [--seeds 1] [--first-seed 0] [--json FILE]
        [--set SECTION.KEY=VALUE ...]

Each flight is replayed in lockstep with everything given, and with attitude and accelerations
alone; seeds but 0 add noise to both (`tests/support/flights/noisy_telemetry.py`). Of each pose that
the gate lets through, predicted ones too, the mean normalised squared error against the truth per
degree of freedom (NEES): 1 is exact, above it errors are larger than stated. In brackets the share
beyond the bound that 95 % should be within.

Place: of the last ten seconds' way in the body's attitude at their beginning, which is what its
standard deviation is of. All the way: the same against errors since sending began, which it does
not claim to cover; the heading is aligned over the first ten seconds. Velocity: in the body's axes,
as it is sent. Heading: against north. Innovations of the filter (NIS) likewise, refused ones too,
by what was measured.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from companion.app.replay.poses_sent import PosesSent
from companion.config_file import load_config
from companion.estimation.body import body_filter
from companion.estimation.body.aiding import Model
from companion.estimation.body.body_state import BodyState
from companion.estimation.body.gated_correction import corrected_by
from companion.estimation.gate.pose_to_send import PoseToSend
from companion.estimation.localisation import LocalisationStage
from companion.geometry.transforms import Array
from companion.messages import Odometry
from companion.runtime.in_order import in_order_of_time
from drivers.open_flight import open_flight
from tests.support.flights.noisy_telemetry import with_noise

WINDOW_NS = 10_000_000_000
BOUNDS = {1: 3.841, 2: 5.991, 3: 7.815}
"""Chi-square that is exceeded once in twenty times, by degrees of freedom."""
FREEDOM = {"heading": 1, "NIS height": 1}
"""Degrees of freedom where there are not three."""
DENIED = 'telemetry.use=["attitude","imu"]'
KINDS = (
    "place", "all the way", "velocity", "heading",
    "NIS place", "NIS flow", "NIS height", "NIS rest",
)  # fmt: skip

Squares = dict[str, list[float]]
"""Squared errors over their stated variances, by kind."""


class Motion(NamedTuple):
    """Places (N, 3), velocities (N, 3), local NED, and rotations of bodies at N times."""

    places_m: Array
    velocities_m_s: Array
    turns: Rotation


class Truth:
    """True motion of the body from the first frame to the last."""

    def __init__(self, flight: Path) -> None:
        rows = np.loadtxt(flight / "truth" / "world_from_camera.tum", ndmin=2)
        mount = np.array(json.loads((flight / "camera.json").read_text())["body_from_camera"])
        bodies = Rotation.from_quat(rows[:, 4:8]) * Rotation.from_matrix(mount[:3, :3]).inv()
        places_m = rows[:, 1:4] - bodies.apply(mount[:3, 3])
        self._start_s = rows[0, 0]
        t_s = rows[:, 0] - self._start_s
        self.first_ns, self.last_ns = (round(t_s * 1e9) for t_s in rows[[0, -1], 0])
        self._place, self._turn = CubicSpline(t_s, places_m), Slerp(t_s, bodies)

    def at(self, times_ns: Array) -> Motion:
        t_s = times_ns * 1e-9 - self._start_s
        return Motion(self._place(t_s), self._place(t_s, 1), self._turn(t_s))


def innovations_watched(found: Squares) -> AbstractContextManager[object]:
    """Keep squared innovations of filters of the body as they come, meanwhile."""

    def watched(state: BodyState, model: Model) -> tuple[BodyState | None, float]:
        after, squared = corrected_by(state, model)
        found[f"NIS {model.kind.value}"].append(squared)
        return after, squared

    return patch.object(body_filter, "corrected_by", watched)


def fly(path: Path, denied: bool, seed: int, settings: list[str]) -> Squares:
    """Errors of the poses sent in one replay."""
    config = load_config(None, [*settings, *([DENIED] if denied else [])])
    flight = open_flight(path, config.camera, config.telemetry)
    stage = LocalisationStage(config, flight.camera, lambda _: nullcontext())
    found, sent = defaultdict[str, list[float]](list), PosesSent(config)
    samples = [s for s in flight.telemetry().samples if s.t_ns > flight.start_ns - WINDOW_NS]
    with innovations_watched(found):
        for message in in_order_of_time(list(with_noise(samples, seed)), flight.frames()):
            sent.take(message)
            for out in stage.step(message):
                if isinstance(out, Odometry):
                    sent.take(out)
    truth = Truth(path)
    for number in sorted({p.reset_counter for p in sent.poses}):
        of_one = [p for p in sent.poses if p.reset_counter == number]
        compare([p for p in of_one if truth.first_ns < p.t_ns < truth.last_ns], truth, found)
    return found


def compare(sent: list[PoseToSend], truth: Truth, found: Squares) -> None:
    """Add the squares of poses without a reset between them, in order of time."""
    if not sent:
        return
    times_ns = np.array([p.t_ns for p in sent])
    places_m = np.stack([p.world_from_body.translation for p in sent])
    turns = Rotation.from_matrix(np.stack([p.world_from_body.rotation for p in sent]))
    velocities = turns.inv().apply(np.stack([p.velocity_world_m_s for p in sent]))
    true = truth.at(times_ns)

    def add(kind: str, errors: Array, sigmas: list[float]) -> None:
        squares = (errors.reshape(len(errors), -1) ** 2).sum(1) / np.square(sigmas)
        found[kind].extend(squares.tolist())

    off = (turns * true.turns.inv()).as_matrix()
    add("heading", np.arctan2(off[:, 1, 0], off[:, 0, 0]), [p.sigma_yaw_rad for p in sent])
    add(
        "velocity", velocities - true.turns.inv().apply(true.velocities_m_s),
        [p.sigma_velocity_m_s for p in sent],
    )  # fmt: skip
    later = np.flatnonzero(times_ns - times_ns[0] >= WINDOW_NS)
    if not len(later):
        return
    before = np.searchsorted(times_ns, times_ns[later] - WINDOW_NS)
    sigmas = [sent[k].sigma_position_m for k in later]
    way = turns[before].inv().apply(places_m[later] - places_m[before])
    true_way = true.turns[before].inv().apply(true.places_m[later] - true.places_m[before])
    add("place", way - true_way, sigmas)
    way, true_way = places_m - places_m[0], true.places_m - true.places_m[0]
    a, b = way[: later[0]], true_way[: later[0]]
    yaw = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a[:, :2] * b[:, :2]).sum())
    north = Rotation.from_rotvec([0.0, 0.0, yaw])
    add("all the way", north.apply(way[later]) - true_way[later], sigmas)


def told(kind: str, squares: list[float]) -> str:
    """Mean per degree of freedom, and the share beyond the bound."""
    if not squares:
        return "-"
    freedom = FREEDOM.get(kind, 3)
    beyond = float(np.mean(np.array(squares) > BOUNDS[freedom]))
    return f"{np.mean(squares) / freedom:.2f} ({100 * beyond:.0f} %)"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("flights", nargs="+", type=Path)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--set", action="append", default=[])
    given = parser.parse_args()
    print(f"| flight | given | seed | poses | {' | '.join(KINDS)} |")
    print("|---" * (4 + len(KINDS)) + "|", flush=True)
    runs = []
    for path in given.flights:
        for denied in (False, True):
            all_seeds: Squares = defaultdict(list)
            for seed in range(given.first_seed, given.first_seed + given.seeds):
                found = fly(path, denied, seed, given.set)
                runs.append({"flight": path.name, "denied": denied, "seed": seed, **found})
                for kind, squares in found.items():
                    all_seeds[kind].extend(squares)
                print(row(path, denied, str(seed), found), flush=True)
                if given.json is not None:
                    given.json.write_text(json.dumps(runs))
            if given.seeds > 1:
                print(row(path, denied, "all", all_seeds), flush=True)


def row(path: Path, denied: bool, seed: str, found: Squares) -> str:
    squares = [told(kind, found.get(kind, [])) for kind in KINDS]
    what, n_poses = "attitude, IMU" if denied else "all", len(found.get("velocity", []))
    return f"| {path.name} | {what} | {seed} | {n_poses} | {' | '.join(squares)} |"


if __name__ == "__main__":
    main()
