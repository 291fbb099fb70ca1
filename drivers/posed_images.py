"""Images of a flight with known camera poses, for the depth engine alone.

The poses are those of `trajectory.tum` in its folder, or the ground truth of its format.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path

import numpy as np

from companion.config import CameraConfig
from companion.errors import FlightError
from companion.geometry.transforms import Array, Pose, interpolate_rotation
from companion.messages import Bytes
from drivers.datasets.tum_rgbd import tum_poses
from drivers.flight import Flight, TruePose
from drivers.open_flight import open_flight

TRAJECTORY = "trajectory.tum"
MAX_GAP_S = 0.5
"""Longest interval over which poses are interpolated."""
SAME_S = 1e-6


class PosedImages:
    """Images in order, with the pose `world_from_camera` of each; None where unknown.

    `numbers` are the frames' numbers in the flight.
    """

    def __init__(self, flight: Flight, poses: Sequence[Pose | None]) -> None:
        self.path, self.camera, self.numbers = flight.path, flight.camera, flight.numbers
        self.flight, self.poses = flight, poses

    def __len__(self) -> int:
        return len(self.numbers)

    def position(self, number: int) -> int:
        """Position in `numbers` of a frame with a pose; FlightError where it is none."""
        if number not in self.numbers:
            known = f"they are {min(self.numbers)} to {max(self.numbers)}"
            raise FlightError(f"{self.path}: there is no frame {number}; {known}")
        position = self.numbers.index(number)
        if self.poses[position] is None:
            raise FlightError(f"{self.path}: frame {number} has no pose")
        return position

    def pictures(self, positions: Iterable[int]) -> Iterator[tuple[int, Bytes]]:
        """RGB images (H, W, 3) by position, ascending; FlightError where one cannot be decoded."""
        for _, numbered in groupby(enumerate(sorted(positions)), lambda each: each[1] - each[0]):
            run = [position for _, position in numbered]
            position_of = {self.numbers[position]: position for position in run}
            ends = self.numbers[run[0]], self.numbers[run[-1]]
            for number, rgb in self.flight.source.pictures(*ends):
                if number not in position_of:
                    continue
                if rgb is None:
                    raise FlightError(f"{self.path}: the image of frame {number} cannot be decoded")
                yield position_of[number], rgb


def open_posed_images(path: Path) -> PosedImages:
    """Images of a flight of any format that has poses; FlightError for any other."""
    flight = open_flight(path, CameraConfig())
    given = tum_poses(path / TRAJECTORY) if (path / TRAJECTORY).is_file() else flight.truth()
    if not given:
        raise FlightError(
            f"{path}: no images with poses: wanted is {TRAJECTORY} in a flight's folder, or a data "
            "set with ground truth (REMODE, TUM RGB-D, EuRoC, KITTI, poses.txt and K.txt)"
        )
    given = sorted(given, key=lambda each: each.t_ns)
    pose_s = np.array([each.t_ns for each in given]) * 1e-9
    return PosedImages(flight, [_pose_at(pose_s, given, t_ns * 1e-9) for t_ns in flight.times_ns])


def _pose_at(pose_s: Array, given: Sequence[TruePose], t_s: float) -> Pose | None:
    after = int(np.searchsorted(pose_s, t_s - SAME_S))
    if after < len(pose_s) and abs(pose_s[after] - t_s) < SAME_S:
        return given[after].world_from_camera
    if after == 0 or after == len(pose_s) or pose_s[after] - pose_s[after - 1] > MAX_GAP_S:
        return None
    a, b = given[after - 1].world_from_camera, given[after].world_from_camera
    share = float((t_s - pose_s[after - 1]) / (pose_s[after] - pose_s[after - 1]))
    return Pose(
        interpolate_rotation(a.rotation, b.rotation, share),
        (1 - share) * a.translation + share * b.translation,
    )
