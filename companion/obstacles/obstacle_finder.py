"""Obstacles around the vehicle now, of tracks, images, the map, and depth.

Depth of a keyframe comes a second or two late. What is told is confirmed by the newest images.
A round that is given the same again finds the same, as a replay does.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.flight_notes import ObstaclePoints
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose, Similarity
from companion.messages import (
    Bytes,
    DepthMap,
    Floats,
    Frame,
    MapUpdate,
    PointChunk,
    Track,
    TrackState,
)
from companion.obstacles.clear_sight import free_sectors
from companion.obstacles.fresh_sight import points_found, rays_of, sectors_seen
from companion.obstacles.newest_sight import NewestSight, Seen, things_in
from companion.obstacles.obstacle_sectors import (
    FREE_M,
    MIN_POINTS,
    N_SECTORS,
    Obstacles,
    known_in,
    obstacles_around,
    sector_of,
)
from companion.obstacles.obstacle_space import cells_with, nearest_in_cells
from companion.obstacles.occupancy_grid import OccupancyGrid
from companion.obstacles.sight_tracks import WINDOW_PX

MAX_AGE_NS = 200_000_000
"""Age of the image that the pose is from, and of that in which a sector was seen, since exposure;
beyond it nothing is known: at 5 m/s all distances are a metre off."""
CELL_POINTS = 2
"""Points for which an occupied cell counts, of `MIN_POINTS`: two in a sector are no outlier."""
THINGS_NS = 1_000_000_000
"""Age up to which a thing in an image stays: from farther away, its distance is known less well."""
MOST_TRACKS = 16
"""Frames within that age, and more at 60 a second: every other is then enough."""
MOST_WAITING = 4
"""Depth maps and chunks between two rounds; of more the newest count. One takes a megabyte."""


@dataclass(frozen=True, slots=True, eq=False)
class Round:
    """Inputs of one look for obstacles: all that had come at its time.

    `tracks` are the newest that found map points, `track` is the newest of all, and `grey` (H, W)
    its image, where that is still there. `depths` have come since the round before. `n_taken` is
    the number of tracks and map updates since the begin of the map.
    """

    t_ns: int
    track: Track | None
    tracks: Sequence[Track]
    update: MapUpdate | None
    grey: Bytes | None
    depths: Sequence[DepthMap | PointChunk]
    n_taken: int


@dataclass(frozen=True, slots=True, eq=False)
class _Known:
    """Points around the vehicle, and what confirms them.

    That are keypoints of the newest frames, with `world_from_camera` of each, and things (M, 3) in
    the newest images.
    """

    t_ns: int
    world_from_body: Pose
    points_world_m: Array
    sights: Sequence[tuple[Floats, Pose]]
    newest: Seen | None
    things_world_m: Array


class ObstacleFinder:
    """Obstacles of what is known of one map.

    `take` and `round` are for one thread, frames may come in another, and `look` may be a third.
    """

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._track: Track | None = None
        self._tracks: deque[Track] = deque(maxlen=MOST_TRACKS)
        """The newest that found map points."""
        self._map: MapUpdate | None = None
        self._forget()
        self._waiting: deque[DepthMap | PointChunk] = deque(maxlen=MOST_WAITING)
        self._n_taken = 0
        self._sight = NewestSight(camera)
        self._greys: deque[tuple[int, Bytes]] = deque(maxlen=MOST_TRACKS)
        """The newest images by their numbers: of one its track comes some images later."""
        self._sighted = -1
        self.looked_from: tuple[int, Pose] | None = None
        """Exposure of the image that the last known obstacles go by, and `world_from_body` then."""

    def _forget(self) -> None:
        self._grid = OccupancyGrid()
        self._things: deque[tuple[int, Array]] = deque(maxlen=MOST_TRACKS)
        """In the newest images."""
        self._anchor: tuple[int, Similarity] | None = None
        """A keyframe near by, and where in the world it was at the look before."""

    def take(self, message: Track | MapUpdate | DepthMap | PointChunk) -> None:
        """Take a track, a map update, a depth map or points."""
        self._n_taken += isinstance(message, Track | MapUpdate)
        if isinstance(message, Track):
            self._track = message
            if message.keypoints_px is not None and not message.backfilled:
                self._tracks.append(message)
        elif isinstance(message, MapUpdate):
            self._map = message
        else:
            self._waiting.append(message)

    def frame(self, frame: Frame) -> None:
        """Take a frame."""
        self._greys.append((frame.seq, frame.grey))

    def round(self, now_ns: int, with_image: bool = True) -> Round:
        """All that a look now goes by; next, it is to be looked at."""
        track, grey = self._track, None
        if track is not None and with_image:
            grey = next((grey for seq, grey in list(self._greys) if seq == track.seq), None)
        depths = [self._waiting.popleft() for _ in range(len(self._waiting))]
        return Round(now_ns, track, list(self._tracks), self._map, grey, depths, self._n_taken)

    def look(
        self, given: Round, parts: Sequence[ObstaclePoints], reach_m: float | None
    ) -> Obstacles | Array | None:
        """Obstacles by the map's own pose; None while that is unknown or old.

        `parts` are of the round's depths. With a reach, metres, obstacles are per sector; without
        one they are the nearest (N, 3) in each part of the space around, metres, in body axes: see
        `companion.obstacles.obstacle_space`.
        """
        known = self._known(given, parts)
        if known is None:
            return None
        self.looked_from = known.t_ns, known.world_from_body
        return self._in_space(known) if reach_m is None else self._in_sectors(known, reach_m)

    def _in_sectors(self, known: _Known, reach_m: float) -> Obstacles:
        """Known are sectors alone in which one of the newest frames has found points of the map."""
        is_seen = np.zeros(N_SECTORS, bool)
        for keypoints_px, world_from_camera in known.sights:
            is_seen |= sectors_seen(
                keypoints_px, world_from_camera, known.world_from_body, self._camera
            )
        things = known.things_world_m - known.world_from_body.translation
        is_seen[sector_of(things, known.world_from_body)] = True
        is_free = np.zeros(N_SECTORS, bool)
        if known.newest is not None and reach_m <= FREE_M:
            is_free = free_sectors(self._grid, known.newest, known.world_from_body)
        return known_in(
            obstacles_around(
                known.t_ns, known.world_from_body, known.points_world_m, is_free, reach_m
            ),
            is_seen | is_free,
        )

    def _in_space(self, known: _Known) -> Array:
        pose = known.world_from_body
        is_seen = cells_with(known.things_world_m - pose.translation, pose)
        for keypoints_px, world_from_camera in known.sights:
            rays = rays_of(keypoints_px, world_from_camera, self._camera)
            is_seen |= cells_with(rays, pose)
        return nearest_in_cells(pose, known.points_world_m, is_seen)

    def _known(self, given: Round, parts: Sequence[ObstaclePoints]) -> _Known | None:
        now_ns, track, update = given.t_ns, given.track, given.update
        if (
            track is None or track.map_from_camera is None
            or update is None or update.georeference is None
        ):  # fmt: skip
            return None
        world_from_map = update.georeference.world_from_map
        world_from_camera = world_from_map.apply_to_pose(track.map_from_camera)
        eye = world_from_camera.translation
        self._follow_map(eye, track, update, world_from_map)
        self._grid.move(eye, now_ns)
        for part in parts:
            place = update.place_of(part.keyframe_id)
            if place is not None:
                points_camera = part.points_camera.astype(np.float64)
                self._grid.hit((world_from_map @ place).apply(points_camera))
        if track.state is not TrackState.TRACKING or now_ns - track.t_ns > MAX_AGE_NS:
            return None
        if given.grey is not None and track.seq != self._sighted:
            self._sighted = track.seq
            self._look_at(track, given.grey, update)
        sights: list[tuple[Floats, Pose]] = []
        points = [np.repeat(self._grid.occupied(), CELL_POINTS, 0)]
        for each in given.tracks:
            pose = each.map_from_camera
            if pose is None or each.keypoints_px is None or now_ns - each.t_ns > MAX_AGE_NS:
                continue
            sights.append((each.keypoints_px, world_from_map.apply_to_pose(pose)))
            if each is track:
                found = points_found(update.points_map, each.keypoints_px, pose, self._camera)
                points.append(world_from_map.apply(found))
                self._grid.doubt(points[-1])
        # one thing counts as enough of a sector: others near it have confirmed it
        stay = [things for t_ns, things in self._things if now_ns - t_ns <= THINGS_NS]
        points += [np.repeat(things, MIN_POINTS, 0) for things in stay]
        now = [things for t_ns, things in self._things if now_ns - t_ns <= MAX_AGE_NS]
        newest = self._sight.newest
        if newest is not None and now_ns - newest.t_ns > MAX_AGE_NS:
            newest = None
        return _Known(
            track.t_ns, world_from_camera @ self._camera.camera_from_body, np.concatenate(points),
            sights, newest, np.concatenate([np.zeros((0, 3)), *now]),
        )  # fmt: skip

    def _look_at(self, track: Track, grey: Bytes, update: MapUpdate) -> None:
        """Take the newest image into the grid."""
        self._sight.add(track, grey, update)
        seen = self._sight.newest
        if seen is None or seen.t_ns != track.t_ns:
            return
        things = things_in(seen, 0.5 * WINDOW_PX / self._camera.fx)
        self._things.append((seen.t_ns, things))
        self._grid.see_through(seen.eye_world_m, seen.ends_world_m)
        self._grid.doubt(np.concatenate([seen.points_world_m, things]))

    def _follow_map(
        self, eye_world_m: Array, track: Track, update: MapUpdate, world_from_map: Similarity
    ) -> None:
        """Take how the map has moved in the world since the look before; of another, all anew."""
        if self._anchor is not None:
            keyframe_id, before = self._anchor
            place = update.place_of(keyframe_id)
            moved = None if place is None else world_from_map @ place @ before.inverse()
            if moved is None or not self._grid.correct(eye_world_m, moved):
                self._forget()
            else:
                for n, (t_ns, things_world_m) in enumerate(self._things):
                    self._things[n] = t_ns, moved.apply(things_world_m)
                if place is not None:
                    self._anchor = keyframe_id, world_from_map @ place
        if track.keyframe_id is not None:
            place = update.place_of(track.keyframe_id)
            if place is not None:
                self._anchor = track.keyframe_id, world_from_map @ place
