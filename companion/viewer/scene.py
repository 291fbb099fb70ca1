"""Messages to entities: what is logged where. Called from one thread.

world                       local NED in metres (z down)
  autopilot/<n>             the autopilot's own path, in pieces
  camera                    the camera now, with its image and the points found in it; not below
                            the map, whose scale no pinhole may have above it
  map                       the map, placed by the georeference
    path/<n>                the camera's path, in pieces
    keyframes/<id>          a keyframe; its points lie in its own frame and move with it
    sparse                  the tracker's points (hidden at first)
depth                       depth of the newest keyframe, near is red
plots/…, log
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from companion.camera import Camera
from companion.config import ViewerConfig
from companion.geometry import Array, Pose, Similarity
from companion.messages import (
    Bytes,
    DepthMap,
    Frame,
    KeyframeAdded,
    MapUpdate,
    Message,
    PointChunk,
    PositionSample,
    PositionSource,
    Track,
    TrackState,
    Warned,
)

APPLICATION = "companion"
PIECE = 50
"""Poses in a piece of a path: only the last piece grows, so that long flights cost no more."""
PIECE_STEP = 5
"""A piece is logged anew when it has grown by so many."""
PATH_STEP_NS = 200_000_000
SPARSE_EVERY = 5
MOVED_UNITS = 1e-4
IMAGE_PLANE_UNITS = 0.15
STATE_LEVEL = {
    TrackState.LOST: 0.0, TrackState.INITIALISING: 1.0, TrackState.COASTING: 1.5,
    TrackState.TRACKING: 2.0,
}  # fmt: skip
COLOUR_PATH = [255, 176, 32]
COLOUR_AUTOPILOT = [120, 150, 255]
COLOUR_FOUND = [80, 230, 120]


@dataclass(slots=True)
class _Path:
    """A path as it grows: the piece that is still open, and how much of it is not logged yet."""

    piece: int = 0
    strip: list[NDArray[np.float32]] = field(default_factory=list)
    waiting: int = 0
    broken: bool = False
    last_t_ns: int = -(2**63)
    colour: list[int] = field(default_factory=list)


class Scene:
    """Logs messages to one recording."""

    def __init__(self, recording: rr.RecordingStream, config: ViewerConfig, camera: Camera) -> None:
        self._rec = recording
        self._config = config
        self._camera = camera
        self._shrink = min(1.0, config.image_width / camera.width)
        self._places: dict[int, Similarity] = {}
        self._update: MapUpdate | None = None
        self._paths: dict[str, _Path] = {}
        self._autopilot_source = PositionSource.GPS
        self._autopilot_t_ns = 0
        self._state: TrackState | None = None
        self._speed_from: tuple[int, Array] | None = None
        recording.log("world", rr.ViewCoordinates.FRD, static=True)
        width, height = round(camera.width * self._shrink), round(camera.height * self._shrink)
        matrix = camera.matrix()
        matrix[:2, 2] += 0.5  # Rerun has pixel centres at halves
        matrix[:2] *= self._shrink
        recording.log(
            "world/camera/image",
            rr.Pinhole(
                image_from_camera=matrix, resolution=[width, height],
                camera_xyz=rr.ViewCoordinates.RDF,
            ),
            static=True,
        )  # fmt: skip

    def take(self, message: Message) -> None:
        """Log one message at its own time."""
        self._rec.set_time("flight", timestamp=np.datetime64(message.t_ns, "ns"))
        if isinstance(message, Frame):
            self._rec.log("world/camera/image", self._encoded(message.rgb))
        elif isinstance(message, Track):
            self._track(message)
        elif isinstance(message, MapUpdate):
            self._map(message)
        elif isinstance(message, PointChunk):
            self._rec.log(
                f"world/map/keyframes/{message.keyframe_id}/points",
                rr.Points3D(
                    message.points_camera, colors=message.rgb, radii=rr.Radius.ui_points(1.5)
                ),
            )
        elif isinstance(message, DepthMap):
            self._depth(message)
        elif isinstance(message, KeyframeAdded):
            self._place(message.keyframe_id, _similarity(message.map_from_camera))
        elif isinstance(message, PositionSample):
            self._autopilot(message)
        elif isinstance(message, Warned):
            text = f"{message.what}: {message.detail}" if message.detail else message.what
            level = rr.TextLogLevel.INFO if message.good else rr.TextLogLevel.WARN
            self._rec.log("log", rr.TextLog(text, level=level))

    def _encoded(self, rgb: Bytes) -> rr.EncodedImage:
        small = rgb
        if self._shrink < 1.0:
            small = np.asarray(
                cv2.resize(
                    rgb, None, fx=self._shrink, fy=self._shrink, interpolation=cv2.INTER_AREA
                ),
                np.uint8,
            )
        quality = [cv2.IMWRITE_JPEG_QUALITY, self._config.jpeg_quality]
        _, jpeg = cv2.imencode(".jpg", np.ascontiguousarray(small[..., ::-1]), quality)
        return rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg")

    def _track(self, track: Track) -> None:
        if track.state is not self._state and not track.backfilled:
            self._state = track.state
            self._rec.log(
                "log", rr.TextLog(f"Tracker is {track.state.value}", level=rr.TextLogLevel.INFO)
            )
        if not track.backfilled:
            self._rec.log("plots/points", rr.Scalars(float(track.n_inliers)))
            self._rec.log("plots/state", rr.Scalars(STATE_LEVEL[track.state]))
        pose = track.map_from_camera
        path = self._paths.setdefault("world/map/path", _Path())
        if pose is None:
            path.broken = True
            return
        if not track.backfilled:
            self._rec.log("world/camera", _transform(_similarity(self._in_world(pose))))
            if track.keypoints_px is not None:
                self._rec.log(
                    "world/camera/image/found",
                    rr.Points2D(
                        (track.keypoints_px + 0.5) * self._shrink, colors=COLOUR_FOUND, radii=1.5
                    ),
                )
        if track.t_ns > path.last_t_ns:  # what is placed after the fact may come too late
            self._extend("world/map/path", track.t_ns, pose.translation, COLOUR_PATH)
        if (
            self._update is not None
            and self._update.georeference is not None
            and not track.backfilled
        ):
            world = self._update.georeference.world_from_map.apply(pose.translation)
            self._rec.log("plots/height", rr.Scalars(float(-world[2])))
            self._speed(track.t_ns, world)

    def _speed(self, t_ns: int, world: Array) -> None:
        before = self._speed_from
        if before is None or t_ns - before[0] > 2_000_000_000:
            self._speed_from = (t_ns, world)
        elif t_ns - before[0] > 400_000_000:
            speed = float(np.linalg.norm(world - before[1])) / ((t_ns - before[0]) * 1e-9)
            self._rec.log("plots/speed", rr.Scalars(speed))
            self._speed_from = (t_ns, world)

    def close(self) -> None:
        """Log what of the paths still waits."""
        for entity, path in self._paths.items():
            self._log_piece(entity, path)

    def _in_world(self, pose: Pose) -> Pose:
        if self._update is None or self._update.georeference is None:
            return pose
        return self._update.georeference.world_from_map.apply_to_pose(pose)

    def _extend(self, entity: str, t_ns: int, position: Array, colour: list[int]) -> None:
        path = self._paths.setdefault(entity, _Path())
        path.colour = colour
        path.last_t_ns = t_ns
        if path.broken and path.strip:
            self._log_piece(entity, path)
            path.piece, path.strip = path.piece + 1, []
        path.broken = False
        path.strip.append(np.asarray(position, np.float32))
        path.waiting += 1
        if len(path.strip) > PIECE:
            self._log_piece(entity, path)
            # a piece begins where the last one ends
            path.piece, path.strip = path.piece + 1, path.strip[-1:]
        elif path.waiting >= PIECE_STEP:
            self._log_piece(entity, path)

    def _log_piece(self, entity: str, path: _Path) -> None:
        if path.waiting == 0 or len(path.strip) < 2:
            return
        path.waiting = 0
        strip = rr.LineStrips3D(
            [np.stack(path.strip)], colors=path.colour, radii=rr.Radius.ui_points(1.5)
        )
        self._rec.log(f"{entity}/{path.piece}", strip)

    def _autopilot(self, sample: PositionSample) -> None:
        order = list(PositionSource)
        if order.index(sample.source) < order.index(self._autopilot_source):
            self._autopilot_source = sample.source
        if sample.source is not self._autopilot_source:
            return
        if sample.t_ns - self._autopilot_t_ns < PATH_STEP_NS:
            return
        self._autopilot_t_ns = sample.t_ns
        self._extend("world/autopilot", sample.t_ns, sample.position_ned_m, COLOUR_AUTOPILOT)

    def _map(self, update: MapUpdate) -> None:
        self._update = update
        if update.georeference is not None:
            self._rec.log("world/map", _transform(update.georeference.world_from_map))
            scale = update.georeference.world_from_map.scale
            self._rec.log("plots/scale", rr.Scalars(scale))
            self._rec.log(
                "world/camera/image",
                rr.Pinhole.from_fields(image_plane_distance=IMAGE_PLANE_UNITS * scale),
            )
        for keyframe_id in update.map_from_camera:
            place = update.place_of(keyframe_id)
            if place is not None:
                self._place(keyframe_id, place)
        if update.revision % SPARSE_EVERY == 1:
            self._rec.log(
                "world/map/sparse",
                rr.Points3D(update.points_map.astype(np.float32), radii=rr.Radius.ui_points(1.0)),
            )

    def _place(self, keyframe_id: int, place: Similarity) -> None:
        """Log where a keyframe lies, unless it has hardly moved."""
        old = self._places.get(keyframe_id)
        if old is not None:
            moved = float(np.abs(old.translation - place.translation).max())
            turned = float(np.abs(old.rotation - place.rotation).max())
            if max(moved, turned) < MOVED_UNITS and old.scale == place.scale:
                return
        self._places[keyframe_id] = place
        self._rec.log(f"world/map/keyframes/{keyframe_id}", _transform(place))

    def _depth(self, depth_map: DepthMap) -> None:
        for kernel, ms in depth_map.kernel_ms.items():
            self._rec.log(f"plots/kernels/{kernel}", rr.Scalars(float(ms)))
        depth = depth_map.depth
        known = depth > 0
        if not known.any():
            return
        inverse = 1.0 / np.where(known, depth, 1.0)
        low, high = np.quantile(inverse[known], [0.02, 0.98])
        level = np.clip((inverse - low) / max(high - low, 1e-12), 0, 1) * 255
        colour = cv2.applyColorMap(level.astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1].copy()
        colour[~known] = 0
        _, png = cv2.imencode(".png", np.ascontiguousarray(colour[..., ::-1]))
        self._rec.log("depth", rr.EncodedImage(contents=png.tobytes(), media_type="image/png"))


def _similarity(pose: Pose) -> Similarity:
    return Similarity(1.0, pose.rotation, pose.translation)


def _transform(place: Similarity) -> rr.Transform3D:
    """A Rerun transform parent_from_child; a matrix, so that no quaternion order comes in."""
    return rr.Transform3D(translation=place.translation, mat3x3=place.rotation * place.scale)
