"""Poses received by a simulated autopilot, as arrays, and their ground truth."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from tests.support.autopilot.fake_autopilot import Received
from tests.support.reference.scoring import read_tum

Array = NDArray[np.float64]
KINDS = "ODOMETRY", "VISION_POSITION_ESTIMATE"


@dataclass(frozen=True)
class Poses:
    """Poses in the order in which they came. Times are seconds.

    A VISION_POSITION_ESTIMATE, as ArduPilot gets of accelerometers alone, has no velocity, and
    counts as of quality 1.
    """

    came_s: Array
    """When, by CLOCK_MONOTONIC."""
    stamp_us: NDArray[np.int64]
    place: Array
    rotations: Array
    velocity_body: Array
    quality: NDArray[np.int64]
    resets: NDArray[np.int64]
    sigma_m: Array

    def between(self, from_ns: int, to_ns: int) -> Array:
        """When those came that came between two times."""
        came_ns = self.came_s * 1e9
        return self.came_s[(came_ns >= from_ns) & (came_ns < to_ns)]

    def after(self, came_s: float) -> Poses:
        """Those that came later."""
        late = self.came_s > came_s
        return Poses(*(getattr(self, each.name)[late] for each in fields(self)))

    def last_before_pause_s(self, from_ns: int, pause_s: float = 0.6) -> float:
        """How long after a time the last one came before there were none for a while."""
        after = self.came_s[self.came_s >= from_ns * 1e-9] - from_ns * 1e-9
        gaps = np.diff(np.r_[0.0, after, np.inf])
        first = int(np.argmax(gaps > pause_s))
        return float(after[first - 1]) if first else 0.0

    def first_after_s(self, from_ns: int) -> float:
        """How long after a time the next one came; infinite if none did."""
        after = self.came_s[self.came_s >= from_ns * 1e-9]
        return float(after[0] - from_ns * 1e-9) if len(after) else float("inf")


def poses_of(received: list[Received]) -> Poses:
    posed = [each for each in received if each.kind in KINDS]
    m = [each.message for each in posed]
    whole = [each.kind == "ODOMETRY" for each in posed]
    rotations = [
        Rotation.from_quat(each.q, scalar_first=True) if has_all
        else Rotation.from_euler("ZYX", [each.yaw, each.pitch, each.roll])
        for each, has_all in zip(m, whole, strict=True)
    ]  # fmt: skip
    known = list(zip(m, whole, strict=True))
    return Poses(
        came_s=np.array([each.monotonic_ns * 1e-9 for each in posed]),
        stamp_us=np.array([e.time_usec if has_all else e.usec for e, has_all in known], np.int64),
        place=np.array([[each.x, each.y, each.z] for each in m]).reshape(-1, 3),
        rotations=np.array([each.as_matrix() for each in rotations]).reshape(-1, 3, 3),
        velocity_body=np.array(
            [[e.vx, e.vy, e.vz] if has_all else [np.nan] * 3 for e, has_all in known]
        ).reshape(-1, 3),
        quality=np.array([e.quality if has_all else 1 for e, has_all in known], np.int64),
        resets=np.array([each.reset_counter for each in m], np.int64),
        sigma_m=np.sqrt(
            [(e.pose_covariance if has_all else e.covariance)[0] for e, has_all in known]
        ),
    )


class TrueFlight:
    """Where the body of a flight with known truth was: its place and attitude at any time."""

    def __init__(self, flight: Path) -> None:
        camera = read_tum(flight / "truth" / "world_from_camera.tum")
        mount = np.array(json.loads((flight / "camera.json").read_text())["body_from_camera"])
        camera_from_body = mount[:3, :3].T
        self.begin_s = float(camera.t_s[0])
        self._t_s = camera.t_s
        self._place = camera.centres - camera.rotations @ camera_from_body @ mount[:3, 3]
        self._turn = Slerp(camera.t_s, Rotation.from_matrix(camera.rotations @ camera_from_body))

    def place(self, t_s: Array) -> Array:
        return np.stack([np.interp(t_s, self._t_s, axis) for axis in self._place.T], 1)

    def rotations(self, t_s: Array) -> Array:
        inside = np.clip(t_s, self._t_s[0], self._t_s[-1])
        out: Array = self._turn(inside).as_matrix()
        return out

    def velocity(self, t_s: Array) -> Array:
        out: Array = (self.place(t_s + 0.1) - self.place(t_s - 0.1)) / 0.2
        return out
