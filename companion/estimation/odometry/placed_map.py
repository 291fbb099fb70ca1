"""The active map in the frame of the odometry, and the frame in which a new one goes on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from companion.estimation.body.aiding import LEAST_SIGMA_PLACE_M
from companion.estimation.body.body_filter import Reckoned
from companion.estimation.body.reckoned_path import BodyPlace
from companion.estimation.odometry.odometry_frame import MapView, OdometryFrame
from companion.geometry.transforms import Array, Pose, yaw_angle, yaw_rotation
from companion.messages import Georeference


@dataclass(frozen=True, slots=True, eq=False)
class PlacedMap:
    """A map, identified by `segment`, and its georeference.

    `began_m` (3,) is where the body was when it was first flown on, in the frame of the odometry.
    """

    segment: int
    georeference: Georeference
    camera_from_body: Pose
    began_m: Array = field(default_factory=lambda: np.zeros(3))

    def world_from_body(self, map_from_camera: Pose) -> Pose:
        """Pose of the body for a camera in the map."""
        camera = self.georeference.world_from_map.apply_to_pose(map_from_camera)
        return camera @ self.camera_from_body

    def map_from_camera(self, world_from_body: Pose) -> Pose:
        """Pose of the camera in the map for a body in the world."""
        camera = world_from_body @ self.camera_from_body.inverse()
        return self.georeference.world_from_map.inverse().apply_to_pose(camera)

    def place_of_camera(self, place_world_m: Array, map_from_camera: Array) -> Array:
        """Place of the camera (3,) in the map, for a place (3,) of the body in the world.

        The rotation (3, 3) is the camera's in the map.
        """
        to_world = self.georeference.world_from_map
        lever_m = to_world.rotation @ map_from_camera @ self.camera_from_body.translation
        return np.asarray(to_world.inverse().apply(place_world_m - lever_m))


class MapStart(NamedTuple):
    """Frame in which a new map is flown on; its poses go on from those before where `goes_on`.

    `off_m` is what its place differs by from that of inertial navigation, None where unknown.
    """

    frame: OdometryFrame
    goes_on: bool
    off_m: float | None


def frame_of(
    placed: PlacedMap, map_from_camera: Pose, first: MapView | None, before: OdometryFrame,
    began: BodyPlace | None, reckoned: Reckoned | None, last_m: Array | None, max_jump_m: float,
) -> MapStart:  # fmt: skip
    """Start of a new map.

    A map without an origin goes on from where inertial navigation had the body at its first view
    (`began`), else from the last known place (3,). There is no jump where that, or the place in a
    map with an origin, is close to where inertial navigation has the body now (`reckoned`). All
    else is a reset: its poses are unrelated. What the map and navigation differ by since its first
    view is owed as far as the map knows that way better: of a climb with a scale that is 4 % off
    the barometer may know more.
    """
    has_origin, raw = placed.georeference.has_origin, placed.world_from_body(map_from_camera)
    turn, offset, owed_m, share = np.eye(3), np.zeros(3), None, np.ones(3)
    if has_origin and reckoned is not None:
        owed_m = raw.translation - reckoned.place_m
    elif not has_origin and first is not None and began is not None:
        raw_first = placed.world_from_body(first.map_from_camera)
        # of the first view: autopilots' headings swing on the way up
        turn = yaw_rotation(yaw_angle(began.rotation @ raw_first.rotation.T))
        offset = before.from_world.apply(began.place_world_m) - turn @ raw_first.translation
        if reckoned is not None:
            owed_m = turn @ raw.translation + offset - reckoned.place_m
            way_m = turn @ (raw.translation - raw_first.translation)
            by_scale_m2 = (placed.georeference.sigma_scale * way_m) ** 2
            grown_m2 = max(reckoned.sigma_place_m**2 - began.sigma_m**2, 0.0)
            share = grown_m2 / (grown_m2 + by_scale_m2 + LEAST_SIGMA_PLACE_M**2)
    elif not has_origin and last_m is not None:
        offset = last_m - raw.translation
    frame = OdometryFrame.settled(Pose(turn, offset), has_origin, before.slewed_m)
    if owed_m is None:
        return MapStart(frame, False, None)
    off_m = float(np.linalg.norm(owed_m))
    if off_m >= max_jump_m:
        return MapStart(frame, False, off_m)
    known = Pose(turn, offset - (1.0 - share) * owed_m)
    moved = OdometryFrame.settled(known, has_origin, before.slewed_m).shifted(-share * owed_m)
    if has_origin:  # satellites' error: it is not owed
        moved = OdometryFrame.settled(moved.from_world, True, before.slewed_m)
    return MapStart(moved, True, off_m)
