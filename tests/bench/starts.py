"""Success of map initialisation: two views from many places of flights with ground truth.

    python -m tests.bench.starts FLIGHT… [--every 25] [--json FILE]

From every so many frames on a map is begun by itself, with the flight's own attitude, one that is
1 degree off at random at each frame, one that is askew by 5 degrees, with 30 % of what is seen
mistaken for something else, and without attitude. Rotation and direction of the way are compared
with the truth; the time is the processor's, until the map has begun.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from companion.config import Config
from companion.estimation.attitude.camera_attitude import CameraAttitude
from companion.geometry.camera import Camera
from companion.geometry.transforms import (
    Array,
    angle_between,
    rotation_from_quaternion,
    rotation_from_vector,
)
from companion.messages import Frame
from companion.runtime.in_order import in_order_of_time
from companion.slam.features.orb_features import FeatureExtractor, Features
from companion.slam.initialisation.bootstrap import Bootstrap
from companion.telemetry import AttitudeSample
from drivers.open_flight import open_flight
from tests.bench.accuracy.injected_faults import OFFSET_AXIS, OFFSET_RAD

MAX_FRAMES = 60
WRONG_RAD = np.radians(10.0)
"""A map whose first way is off by more will not be put right."""
MISTAKEN_SHARE = 1.0 - 0.7**0.5
"""In each of two views, so that 30 % of matches are wrong."""
MIN_WAY_M = 0.05
NOTHING = np.zeros((1, 1), np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A frame, what it shows, its attitude as told, and where it truly was taken."""

    frame: Frame
    features: Features
    ned_from_camera: Array | None
    rotation: Array
    centre: Array


Fault = Callable[[Seen, np.random.Generator], Seen]


def as_told(seen: Seen, rng: np.random.Generator) -> Seen:
    return seen


def noisy(seen: Seen, rng: np.random.Generator) -> Seen:
    if seen.ned_from_camera is None:
        return seen
    turn = rotation_from_vector(rng.normal(scale=np.radians(1.0), size=3))
    return replace(seen, ned_from_camera=seen.ned_from_camera @ turn)


def askew(seen: Seen, rng: np.random.Generator) -> Seen:
    if seen.ned_from_camera is None:
        return seen
    turn = rotation_from_vector(OFFSET_RAD * OFFSET_AXIS / np.linalg.norm(OFFSET_AXIS))
    return replace(seen, ned_from_camera=seen.ned_from_camera @ turn)


def mistaken(seen: Seen, rng: np.random.Generator) -> Seen:
    n = len(seen.features)
    some = rng.permutation(n)[: int(MISTAKEN_SHARE * n)]
    descriptors = seen.features.descriptors.copy()
    descriptors[some] = descriptors[np.roll(some, 1)]
    return replace(seen, features=replace(seen.features, descriptors=descriptors))


def untold(seen: Seen, rng: np.random.Generator) -> Seen:
    return replace(seen, ned_from_camera=None)


FAULTS: dict[str, Fault] = {
    "as told": as_told, "1 degree of noise": noisy, "askew by 5 degrees": askew,
    "30 % mistaken": mistaken, "no attitude": untold,
}  # fmt: skip


def flown(path: Path) -> tuple[Camera, list[Seen]]:
    config = Config()
    flight = open_flight(path, config.camera, config.telemetry)
    attitude = CameraAttitude(flight.camera.body_from_camera)
    truth = np.loadtxt(path / "truth" / "world_from_camera.tum")
    extractor = FeatureExtractor(config.features, flight.camera)
    out = []
    for message in in_order_of_time(flight.telemetry().samples, flight.frames()):
        if isinstance(message, AttitudeSample):
            attitude.add(message)
        elif isinstance(message, Frame):
            row = truth[int(np.abs(truth[:, 0] * 1e9 - message.t_ns).argmin())]
            out.append(
                Seen(
                    Frame(message.seq, message.t_ns, NOTHING, NOTHING),
                    extractor.extract(message.grey), attitude.at(message.t_ns),
                    rotation_from_quaternion(row[[7, 4, 5, 6]]), row[1:4],
                )
            )  # fmt: skip
    return flight.camera, out


def begin(camera: Camera, seen: list[Seen], fault: Fault) -> dict[str, Any]:
    """One start: frames that it took, errors in rad, ms of the processor in all and each time."""
    cpu_s: list[float] = []
    rng = np.random.default_rng(seen[0].frame.seq)
    trial = Bootstrap(camera)
    of_seq = {s.frame.seq: s for s in seen}
    for k, each in enumerate(seen):
        now = fault(each, rng)
        before_s = time.process_time()
        start = trial.step(now.frame, now.features, now.ned_from_camera)
        cpu_s.append(time.process_time() - before_s)
        if start is None:
            continue
        a, b = of_seq[start.first.seq], of_seq[start.second.seq]
        found = start.second.camera_from_map @ start.first.camera_from_map.inverse()
        way = b.rotation.T @ (a.centre - b.centre)
        if np.linalg.norm(way) < MIN_WAY_M:
            way *= np.nan  # made up
        cosine = found.translation @ way / np.linalg.norm(found.translation) / np.linalg.norm(way)
        return {
            "frames": k, "turn_rad": angle_between(found.rotation, b.rotation.T @ a.rotation),
            "way_rad": float(np.arccos(np.clip(cosine, -1, 1))),
            "ms": 1e3 * sum(cpu_s), "ms_each": 1e3 * float(np.mean(cpu_s)),
        }  # fmt: skip
    return {"frames": None, "ms": 1e3 * sum(cpu_s),
            "ms_each": 1e3 * float(np.mean(cpu_s))}  # fmt: skip


def row(flight: str, fault: str, starts: list[dict[str, Any]]) -> str:
    begun = [s for s in starts if s["frames"] is not None]
    right = [s for s in begun if s["way_rad"] < WRONG_RAD]

    def parts(key: str) -> str:
        values = np.degrees([s[key] for s in begun]) if begun else np.array([np.nan])
        return f"{np.nanmedian(values):.3f} / {np.nanpercentile(values, 90):.3f}"

    return (
        f"| {flight} | {fault} | {len(right)} / {len(begun)} / {len(starts)} "
        f"| {np.mean([s['frames'] for s in begun]) if begun else np.nan:.1f} "
        f"| {parts('turn_rad')} | {parts('way_rad')} "
        f"| {np.mean([s['ms'] for s in starts]):.0f} "
        f"| {np.nanmean([s['ms_each'] for s in starts]):.1f} |"
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("flights", nargs="+", type=Path)
    parser.add_argument("--every", type=int, default=25)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--faults", nargs="*", default=list(FAULTS), choices=list(FAULTS))
    given = parser.parse_args()
    print(
        "| flight | | right / begun / tried | frames | rotation off, median / 90 % | way off "
        "| ms a start | ms a try |\n|---|---|---|---|---|---|---|---|"
    )
    every: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for path in given.flights:
        camera, seen = flown(path)
        for name in given.faults:
            starts = [
                begin(camera, seen[k : k + MAX_FRAMES], FAULTS[name])
                for k in range(0, len(seen) - MAX_FRAMES, given.every)
            ]
            every.setdefault(path.name, {})[name] = starts
            print(row(path.name, name, starts), flush=True)
    if given.json is not None:
        given.json.write_text(json.dumps(every))


if __name__ == "__main__":
    main()
