"""Scene encoder: messages to items for viewers. No clock, no I/O."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field, replace

import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Array, Pose, Similarity
from companion.health import Health
from companion.messages import (
    DepthMap,
    Floats,
    Frame,
    KeyframeAdded,
    MapUpdate,
    Message,
    ObstaclesSeen,
    Odometry,
    PointChunk,
    Track,
    TrackState,
    Warned,
)
from companion.streaming.depth_picture import depth_picture
from companion.streaming.items import (
    NO_PIXELS,
    WHOLE,
    AutopilotPathItem,
    FlightItem,
    ImageItem,
    Item,
    LogItem,
    ObstaclesItem,
    PathItem,
    PointsItem,
    PoseItem,
    Shown,
    SparseItem,
    StatusItem,
)
from companion.streaming.keyframe_placement import KeyframePlacement
from companion.streaming.status_facts import StatusFacts
from companion.telemetry import PositionSample, PositionSource, Telemetry

Watched = Message | Health | GeoOrigin
"""Messages that can be shown."""
STATUS_EVERY_NS = 1_000_000_000
SPEED_OVER_NS = 400_000_000
PIECE = 50
"""Positions in a piece of a path: only the last piece grows, so that long flights cost no more."""
PIECE_STEP = 5
"""A piece is sent again when it has grown by this many."""
AUTOPILOT_STEP_NS = 200_000_000
SPARSE_EVERY = 5
MOST_IMAGES_HELD = 4
"""Frames that wait for their track."""
IN_WORDS = {
    TrackState.INITIALISING: Shown.INITIALISING,
    TrackState.TRACKING: Shown.TRACKING,
    TrackState.DEAD_RECKONING: Shown.DEAD_RECKONING,
    TrackState.LOST: Shown.LOST,
    TrackState.STANDING: Shown.STANDING,
}


@dataclass(slots=True)
class _Piece:
    """Piece of a path that still grows."""

    number: int = 0
    keyframe_id: int = -1
    strip: list[Floats] = field(default_factory=list)
    n_waiting: int = 0


class SceneEncoder:
    """Encodes one flight. `path_step_ns` thins the camera's path."""

    def __init__(self, flight: FlightItem, path_step_ns: int = 0) -> None:
        self.flight = replace(flight, origin=None)
        self._origin = flight.origin
        self._path_step_ns = path_step_ns
        self._facts = StatusFacts()
        self._status_ns = -(2**63)
        self._update: MapUpdate | None = None
        self._placement = KeyframePlacement()
        self._path, self._autopilot_path = _Piece(), _Piece()
        self._path_ns, self._autopilot_ns = -(2**63), -(2**63)
        self._last_position_map: Array | None = None
        self._source = PositionSource.GPS
        self._shown = Shown.WAITING
        self._quality = -1
        self._speed: float | None = None
        self._speed_from: tuple[int, Array] | None = None
        self._images: OrderedDict[int, ImageItem] = OrderedDict()

    @property
    def camera(self) -> Camera:
        """Camera of the flight."""
        return self.flight.camera

    def take(self, message: Watched) -> list[Item]:
        """Items that show a message."""
        if isinstance(message, GeoOrigin):
            self._origin = message
            return self._origin_if_known()
        out: list[Item] = []
        if isinstance(message, Frame):
            if not message.rgb.size:
                return []  # a grey one, for depth alone
            self._images[message.seq] = ImageItem(message.t_ns, message.rgb)
            if len(self._images) > MOST_IMAGES_HELD:
                out.append(self._images.popitem(last=False)[1])
        elif isinstance(message, Track):
            out += self._track(message)
        elif isinstance(message, Odometry):
            self._quality = message.quality
            velocity = message.velocity_world_m_s
            self._speed = float(np.linalg.norm(velocity)) if velocity is not None else None
        elif isinstance(message, MapUpdate):
            out += self._map(message)
        elif isinstance(message, PointChunk):
            self._facts.points_came(message.keyframe_id, len(message.points_camera))
            out += self._placement.measured(message)
            out.append(PointsItem(
                message.t_ns, message.keyframe_id, WHOLE, message.points_camera, message.rgb,
                message.confidence,
            ))  # fmt: skip
        elif isinstance(message, DepthMap):
            item = depth_picture(message)
            out += [item] if item is not None else []
        elif isinstance(message, ObstaclesSeen):
            out.append(ObstaclesItem(
                message.t_ns, message.eye_world, message.edges_world, message.free_world
            ))  # fmt: skip
        elif isinstance(message, KeyframeAdded):
            out += self._placement.added(message)
        elif isinstance(message, PositionSample):
            out += self._autopilot(message)
        elif isinstance(message, Telemetry):
            self._facts.measured(message)
        elif isinstance(message, Warned):
            text = f"{message.what}: {message.detail}" if message.detail else message.what
            self._facts.warned(message)
            out.append(LogItem(message.t_ns, text, not message.good))
        elif isinstance(message, Health):
            self._facts.health = message
        return out + self._status(message)

    def close(self) -> list[Item]:
        """Items that are still held back."""
        out: list[Item] = list(self._images.values())
        self._images.clear()
        for piece in (self._path, self._autopilot_path):
            out += self._items_of(piece, max(self._path_ns, self._autopilot_ns))
        return out

    # -- the camera ------------------------------------------------------------------------------

    def _track(self, track: Track) -> list[Item]:
        out: list[Item] = []
        pose = track.map_from_camera
        if not track.backfilled:
            out += self._state(track)
            self._facts.tracked(track)
            out += self._image_of(track)
        if pose is None:
            if not track.backfilled:
                out += self._break_path(track.t_ns)
                out.append(PoseItem(track.t_ns, self._shown, quality=self._quality))
            return out
        if track.t_ns > self._path_ns + self._path_step_ns - 1:
            out += self._extend(track)
        if not track.backfilled:
            out.append(self._pose(track, pose))
        return out

    def _state(self, track: Track) -> list[Item]:
        shown = IN_WORDS[track.state]
        if shown is self._shown:
            return []
        self._shown = shown
        self._facts.shown = shown
        bad = shown in (Shown.DEAD_RECKONING, Shown.LOST)
        return [LogItem(track.t_ns, f"Tracker: {shown.value.lower()}", bad)]

    def _image_of(self, track: Track) -> list[Item]:
        image = self._images.pop(track.seq, None)
        if image is None:
            return []
        found = NO_PIXELS
        if track.keypoints_px is not None:  # which count in the camera's pixels
            shrink = np.float32(image.rgb.shape[1] / self.camera.width)
            found = (track.keypoints_px + np.float32(0.5)) * shrink - np.float32(0.5)
        return [ImageItem(image.t_ns, image.rgb, found)]

    def _pose(self, track: Track, pose: Pose) -> PoseItem:
        height = None
        world = self._placement.world
        if world is not None:
            pose = world.apply_to_pose(pose)
            height = float(-pose.translation[2])
            self._measure_speed(track.t_ns, pose.translation)
        self._facts.height_m, self._facts.speed_m_s = height, self._speed
        return PoseItem(
            track.t_ns, self._shown, pose, track.n_inliers, self._quality, height, self._speed
        )

    def _measure_speed(self, t_ns: int, world: Array) -> None:
        """Estimate the speed from recent poses, where no other source gives it."""
        before = self._speed_from
        if before is None or t_ns - before[0] > 5 * SPEED_OVER_NS:
            self._speed_from = (t_ns, world)
        elif t_ns - before[0] > SPEED_OVER_NS:
            moved_m = float(np.linalg.norm(world - before[1]))
            self._speed = moved_m / ((t_ns - before[0]) * 1e-9)
            self._speed_from = (t_ns, world)

    # -- paths -----------------------------------------------------------------------------------

    def _extend(self, track: Track) -> list[Item]:
        """Add a position to the path, in the frame of its keyframe."""
        keyframe_id, relative = track.keyframe_id, track.keyframe_from_camera
        if keyframe_id is None or relative is None or track.map_from_camera is None:
            return []
        self._path_ns = track.t_ns
        piece, out = self._path, []
        if keyframe_id != piece.keyframe_id or len(piece.strip) > PIECE:
            out += self._items_of(piece, track.t_ns)
            before = self._last_position_map if piece.strip else None
            self._path = piece = _Piece(piece.number + 1, keyframe_id)
            if before is not None:  # a piece begins where the last one ends
                place = self._keyframe_pose(track, track.map_from_camera, relative)
                piece.strip.append(place.inverse().apply(before).astype(np.float32))
        piece.strip.append(relative.translation.astype(np.float32))
        piece.n_waiting += 1
        self._last_position_map = track.map_from_camera.translation
        return out + (self._items_of(piece, track.t_ns) if piece.n_waiting >= PIECE_STEP else [])

    def _keyframe_pose(self, track: Track, pose: Pose, relative: Pose) -> Similarity:
        """Pose of the tracker's keyframe, which the map may not have yet."""
        units = self._update.scale_of if self._update is not None else {}
        scale = units.get(track.keyframe_id or 0, 1.0)
        rotation = pose.rotation @ relative.rotation.T
        return Similarity(
            scale, rotation, pose.translation - scale * rotation @ relative.translation
        )

    def _break_path(self, t_ns: int) -> list[Item]:
        out = self._items_of(self._path, t_ns)
        self._path = _Piece(self._path.number + 1)
        return out

    def _items_of(self, piece: _Piece, t_ns: int) -> list[Item]:
        if piece.n_waiting == 0 or len(piece.strip) < 2:
            return []
        piece.n_waiting = 0
        strip = np.stack(piece.strip)
        if piece is self._autopilot_path:
            return [AutopilotPathItem(t_ns, piece.number, strip)]
        return [PathItem(t_ns, piece.number, piece.keyframe_id, strip)]

    def _autopilot(self, sample: PositionSample) -> list[Item]:
        order = list(PositionSource)
        if order.index(sample.source) < order.index(self._source):
            self._source = sample.source
        too_soon = sample.t_ns - self._autopilot_ns < AUTOPILOT_STEP_NS
        if sample.source is not self._source or too_soon:
            return []
        self._autopilot_ns = sample.t_ns
        piece, out = self._autopilot_path, []
        piece.strip.append(np.asarray(sample.position_ned_m, np.float32))
        piece.n_waiting += 1
        if len(piece.strip) > PIECE:
            out = self._items_of(piece, sample.t_ns)
            self._autopilot_path = _Piece(piece.number + 1, strip=piece.strip[-1:])
        elif piece.n_waiting >= PIECE_STEP:
            out = self._items_of(piece, sample.t_ns)
        return out

    # -- the map ---------------------------------------------------------------------------------

    def _map(self, update: MapUpdate) -> list[Item]:
        self._update = update
        self._facts.mapped(update)
        out = self._origin_if_known()
        out += self._placement.mapped(update)
        if update.revision % SPARSE_EVERY == 1:
            out.append(SparseItem(update.t_ns, update.points_map.astype(np.float32)))
        return out

    def _origin_if_known(self) -> list[Item]:
        """Geodetic origin, once the map is known to be georeferenced."""
        found = self._update.georeference if self._update is not None else None
        if found is None or not found.has_origin or self._origin is self.flight.origin:
            return []
        self.flight = replace(self.flight, origin=self._origin)
        return [self.flight]

    # -- status ----------------------------------------------------------------------------------

    def _status(self, message: Watched) -> list[Item]:
        """Status item, about once a second of the flight."""
        if isinstance(message, GeoOrigin):
            return []
        since = message.t_ns - self._status_ns
        if not isinstance(message, (Track, Health)) or since < STATUS_EVERY_NS:
            return []
        self._status_ns = message.t_ns
        return [StatusItem(message.t_ns, self._facts.facts(self._quality))]
