"""The map that is flown on: where its poses are in the frame of the odometry."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from companion.estimation.odometry.odometry_frame import OdometryFrame
from companion.estimation.odometry.placed_map import MapStart, PlacedMap
from companion.geometry.transforms import Array, Pose
from companion.messages import Georeference


class LastPose(NamedTuple):
    """The last accepted frame: its time, and the pose that was given out for it.

    `sigma_m` is the standard deviation of its place beside what the map drifts by.
    """

    t_ns: int
    map_from_camera: Pose
    odometry_from_body: Pose
    sigma_m: float

    @property
    def place_m(self) -> Array:
        """Place (3,) of the body."""
        return self.odometry_from_body.translation


class FlownMap:
    """The active map, the frame of the odometry in the world, and the last pose in both."""

    def __init__(self, camera_from_body: Pose) -> None:
        self.camera_from_body = camera_from_body
        self.placed: PlacedMap | None = None
        """None before the first."""
        self.frame = OdometryFrame()
        self.last: LastPose | None = None
        """None where the next pose is taken as it is."""

    @property
    def georeference(self) -> Georeference | None:
        """Georeference of the map; None before the first."""
        return None if self.placed is None else self.placed.georeference

    def begin(self, placed: PlacedMap, start: MapStart, map_from_camera: Pose) -> None:
        """Go on in another map, from its pose of now."""
        began = start.frame.from_world @ placed.world_from_body(map_from_camera)
        self.placed = replace(placed, began_m=began.translation, way=start.way)
        self.frame, self.last = start.frame, None

    def resume(self, placed: PlacedMap, from_world: Pose, anchored: bool) -> None:
        """Go on in a stored map and frame."""
        self.placed = placed
        self.frame = OdometryFrame.settled(from_world, anchored, self.frame.slewed_m)
        self.last = None

    def hold(self, t_ns: int, odometry_from_body: Pose, sigma_m: float) -> None:
        """Take a pose that the map did not give: the next by the map has to fit it."""
        if self.placed is not None:
            world_from_body = self.frame.from_world.inverse() @ odometry_from_body
            pose = self.placed.map_from_camera(world_from_body)
            self.last = LastPose(t_ns, pose, odometry_from_body, sigma_m)

    def place_of_camera(self, place_m: Array, map_from_camera: Array) -> Array | None:
        """Place of the camera (3,) in the map, for a place (3,) of the body.

        The place is in the frame of the odometry, metres; the rotation (3, 3) is the camera's in
        the map. None without a georeference.
        """
        if self.placed is None:
            return None
        place_world_m = self.frame.from_world.inverse().apply(place_m)
        return self.placed.place_of_camera(place_world_m, map_from_camera)

    def georeferenced(self, georeference: Georeference) -> float:
        """Change the georeference, keeping the last pose; by how much the scale has grown.

        What the way since the map's first view is known better by is owed.
        """
        assert self.placed is not None
        before = self.placed.georeference
        ratio = georeference.world_from_map.scale / before.world_from_map.scale
        way = self.placed.way if self.placed.way is None else self.placed.way.scaled(ratio)
        if self.last is not None:
            placed = replace(self.placed, georeference=georeference)
            raw = placed.world_from_body(self.last.map_from_camera)
            self.frame = self.frame.holding(self.last.odometry_from_body, raw)
            if way is not None and self.placed.way is not None and not georeference.has_origin:
                known_m = self.placed.way.beyond_m(before.sigma_scale)
                self.frame = self.frame.owing(way.beyond_m(georeference.sigma_scale) - known_m)
        self.placed = replace(self.placed, georeference=georeference, way=way)
        return ratio

    def corrected(self, map_from_camera: Pose) -> None:
        """Apply a correction of the map: the camera's pose of the last frame now.

        The pose that was given out is kept; the difference is slewed.
        """
        assert self.placed is not None and self.last is not None
        self.last = self.last._replace(map_from_camera=map_from_camera)
        raw = self.placed.world_from_body(map_from_camera)
        self.frame = self.frame.corrected(self.last.odometry_from_body, raw)

    def way_m(self) -> float:
        """Distance from where the map was first flown on."""
        assert self.placed is not None and self.last is not None
        return float(np.linalg.norm(self.last.place_m - self.placed.began_m))
