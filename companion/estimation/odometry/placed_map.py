"""The active map in the frame of the odometry, and the frame in which a new one goes on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from companion.estimation.body.aiding import LEAST_SIGMA_PLACE_M
from companion.estimation.body.body_state import Reckoned
from companion.estimation.body.reckoned_path import BodyPlace
from companion.estimation.odometry.odometry_frame import MapView, OdometryFrame
from companion.geometry.transforms import Array, Pose, yaw_angle, yaw_rotation
from companion.messages import Georeference


class WaySinceFirstView(NamedTuple):
    """Way from a map's first view to where it was first flown on, by the map (3,), metres.

    `off_m` (3,) is what inertial navigation has less of it, whose variance has grown by `grown_m2`
    meanwhile.
    """

    way_m: Array
    off_m: Array
    grown_m2: float

    def beyond_m(self, sigma_scale: float) -> Array:
        """Part of that (3,) which the map knows better: of a climb a barometer may know more."""
        by_scale_m2 = (sigma_scale * self.way_m) ** 2
        share = self.grown_m2 / (self.grown_m2 + by_scale_m2 + LEAST_SIGMA_PLACE_M**2)
        return np.asarray(share * self.off_m)

    def scaled(self, ratio: float) -> WaySinceFirstView:
        """The same with a scale that has grown."""
        return self._replace(
            way_m=ratio * self.way_m, off_m=self.off_m + (ratio - 1.0) * self.way_m
        )


@dataclass(frozen=True, slots=True, eq=False)
class PlacedMap:
    """A map, identified by `segment`, and its georeference.

    `began_m` (3,) is where the body was when it was first flown on, in the frame of the odometry;
    `way` leads there, None where navigation did not know the first view.
    """

    segment: int
    georeference: Georeference
    camera_from_body: Pose
    began_m: Array = field(default_factory=lambda: np.zeros(3))
    way: WaySinceFirstView | None = None

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

    `off_m` is what its place differs by from that of inertial navigation, None where unknown, and
    `way` the one since its first view.
    """

    frame: OdometryFrame
    goes_on: bool
    off_m: float | None
    way: WaySinceFirstView | None = None


def frame_of(
    placed: PlacedMap, map_from_camera: Pose, first: MapView | None, before: OdometryFrame,
    began: BodyPlace | None, reckoned: Reckoned | None, last_m: Array | None, max_jump_m: float,
) -> MapStart:  # fmt: skip
    """Start of a new map.

    A map without an origin goes on from where inertial navigation had the body at its first view
    (`began`), else from the last known place (3,). There is no jump where that, or the place in a
    map with an origin, is close to where inertial navigation has the body now (`reckoned`). All
    else is a reset: its poses are unrelated. What the map and navigation differ by since its first
    view is owed as far as the map knows that way better.
    """
    has_origin, raw = placed.georeference.has_origin, placed.world_from_body(map_from_camera)
    turn, offset, off_m, way = np.eye(3), np.zeros(3), None, None
    if has_origin and reckoned is not None:
        off_m = raw.translation - reckoned.place_m
    elif not has_origin and first is not None and began is not None:
        raw_first = placed.world_from_body(first.map_from_camera)
        # of the first view: autopilots' headings swing on the way up
        turn = yaw_rotation(yaw_angle(began.rotation @ raw_first.rotation.T))
        offset = before.from_world.apply(began.place_world_m) - turn @ raw_first.translation
        if reckoned is not None:
            off_m = turn @ raw.translation + offset - reckoned.place_m
            way = WaySinceFirstView(
                turn @ (raw.translation - raw_first.translation), off_m,
                max(reckoned.sigma_place_m**2 - began.sigma_m**2, 0.0),
            )  # fmt: skip
    elif not has_origin and last_m is not None:
        offset = last_m - raw.translation
    frame = OdometryFrame.settled(Pose(turn, offset), has_origin, before.slewed_m)
    if off_m is None:
        return MapStart(frame, False, None)
    far_m = float(np.linalg.norm(off_m))
    if far_m >= max_jump_m:
        return MapStart(frame, False, far_m)
    frame = OdometryFrame.settled(Pose(turn, offset - off_m), has_origin, before.slewed_m)
    if way is not None:  # of satellites it is their error: it is not owed
        frame = frame.owing(way.beyond_m(placed.georeference.sigma_scale))
    return MapStart(frame, True, far_m, way)
