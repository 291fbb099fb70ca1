"""Pictures of the flight for exports that need them: which, and undistorted at their poses."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from companion.dense.undistortion import Undistortion
from companion.errors import InputError
from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Array
from companion.messages import Bytes
from companion.products.flight_result import WorldPose
from companion.products.run_folder import FinishedRun

MAX_TURN_RAD = np.radians(10.0)


class PlacedPicture(NamedTuple):
    """Undistorted image (H, W, 3) and the pose of its frame."""

    pose: WorldPose
    rgb: Bytes


@dataclass(eq=False)
class FlightPictures:
    """Frames of the flight that a run is of.

    `frames` gives the images (H, W, 3) of times, as far as they are there, in order of time; `path`
    is for messages.
    """

    run: FinishedRun
    path: Path
    frames: Callable[[Collection[int]], Iterator[tuple[int, Bytes]]]

    @cached_property
    def undistortion(self) -> Undistortion:
        """To the pinhole camera of all pictures."""
        return Undistortion(camera_of(self.run))

    @property
    def camera(self) -> Camera:
        """The pinhole camera of all pictures."""
        k, camera = self.undistortion.intrinsics, camera_of(self.run)
        return Camera(camera.width, camera.height, k.fx, k.fy, k.cx, k.cy)

    def spaced(self, step: float) -> Iterator[PlacedPicture]:
        """Pictures apart by `step` of the distance to what they see, or by ten degrees.

        InputError where there is none, or of another size than the run's.
        """
        wanted = {pose.t_ns: pose for pose in spaced(self.run, step)}
        camera = camera_of(self.run)
        n = 0
        for t_ns, rgb in self.frames(wanted):
            if rgb.shape[:2] != (camera.height, camera.width):
                raise InputError(
                    f"{self.path}: its pictures are {rgb.shape[1]} x {rgb.shape[0]}, those of "
                    f"{self.run.path} were {camera.width} x {camera.height}"
                )
            n += 1
            yield PlacedPicture(wanted[t_ns], self.undistortion.image(rgb))
        if not n:
            raise InputError(
                f"{self.path}: none of its pictures has the time of a pose of {self.run.path}: is "
                "it the flight that was replayed?"
            )


def spaced(run: FinishedRun, step: float) -> list[WorldPose]:
    """Poses apart by `step` of the distance to the nearest point of the cloud, or by a turn."""
    if not run.poses or not len(run.cloud):
        raise InputError(f"{run.path}: it has no path or no cloud")
    places = np.stack([pose.world_from_camera.translation for pose in run.poses])
    nearest, _ = cKDTree(run.cloud.points).query(places)
    out: list[WorldPose] = []
    for pose, near in zip(run.poses, nearest, strict=True):
        if out:
            last = out[-1].world_from_camera.inverse() @ pose.world_from_camera
            turn = np.arccos(np.clip((np.trace(last.rotation) - 1) / 2, -1, 1))
            if np.linalg.norm(last.translation) < step * near and turn < MAX_TURN_RAD:
                continue
        out.append(pose)
    return out


def camera_of(run: FinishedRun) -> Camera:
    """The camera that the run was made with; InputError where its report does not have it."""
    said: Mapping[str, Any] = run.report.get("camera") or {}
    try:
        fx, fy, cx, cy = (float(said[name]) for name in ("fx", "fy", "cx", "cy"))
        return Camera(
            int(said["width"]), int(said["height"]), fx, fy, cx, cy,
            Distortion(said["distortion"]), tuple(float(c) for c in said["coefficients"]),
        )  # fmt: skip
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{run.path / 'report.json'}: it does not tell the camera") from error


def enu(points_ned: Array) -> Array:
    """East, north, up (..., 3) of north, east, down."""
    return np.asarray(points_ned, np.float64)[..., [1, 0, 2]] * [1, 1, -1]
