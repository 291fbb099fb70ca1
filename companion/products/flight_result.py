"""Results of a flight, gathered message by message."""

from __future__ import annotations

from array import array
from collections.abc import Generator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from companion.dense.local_scale import local_scale_of_points
from companion.geometry.transforms import Array, Pose, Similarity
from companion.messages import (
    DepthMap,
    Frame,
    Georeference,
    KeyframeAdded,
    LoopClosed,
    MapUpdate,
    Message,
    Odometry,
    PointChunk,
    Track,
    TrackRefined,
    Warned,
)
from companion.products.chunk_store import ChunkStore
from companion.products.cloud import Cloud, no_cloud, placed
from companion.products.depth_pictures import DepthPicture, DepthPictures
from companion.products.gathered_cloud import gathered
from companion.products.track_store import TrackStore
from companion.telemetry import PositionSample, PositionSource
from companion.timing.clock import StageTimes

POSITION_STEP_NS = 100_000_000
VOXEL_PER_DEPTH = 0.01
"""Voxel size over the median depth, without a metric scale."""
GIVEN_UP = "points were given up, as the disk does not take them"


class WorldPose(NamedTuple):
    """Pose of a frame: `world_from_camera` in metres, or in map units without a scale."""

    seq: int
    t_ns: int
    world_from_camera: Pose


@dataclass(slots=True)
class WarningCount:
    """Number of warnings of one kind, and the first detail."""

    count: int
    first_t_ns: int
    first_detail: str


class FlightResult:
    """Sink that keeps the data that results are made of.

    It holds one track per frame, a dozen small pictures and the autopilot's path at 10 Hz at most.
    Of the points of all keyframes it holds `memory_mb` at most, if `folder` can take the others.
    """

    def __init__(self, folder: Path | None = None, memory_mb: float = np.inf) -> None:
        self.n_frames = 0
        self.first_t_ns: int | None = None
        self.last_t_ns: int | None = None
        self.warnings: dict[str, WarningCount] = {}
        self.refused: Mapping[str, int] = {}
        """Number of measurements that did not fit the body's motion, by kind."""
        self.update: MapUpdate | None = None
        self.loop_closures: list[LoopClosed] = []
        self._tracks = TrackStore()
        self._chunks = ChunkStore(folder, memory_mb)
        self._median_depths: dict[int, float] = {}
        self._keyframe_t_ns: dict[int, int] = {}
        self._kernel_times = StageTimes()
        self._positions: dict[PositionSource, tuple[array[int], array[float]]] = {}
        """Times, and coordinates one after the other."""
        self._pictures = DepthPictures()

    def take(self, message: Message) -> None:
        """Take one message."""
        if isinstance(message, Frame):
            self.n_frames += 1
            if self.first_t_ns is None:
                self.first_t_ns = message.t_ns
            self.last_t_ns = message.t_ns
        elif isinstance(message, Track):
            self._tracks.put(message)
        elif isinstance(message, TrackRefined):
            self._tracks.refine(message)
        elif isinstance(message, Odometry):
            self.refused = message.refused
        elif isinstance(message, MapUpdate):
            self.update = message
        elif isinstance(message, KeyframeAdded):
            self._keyframe_t_ns[message.keyframe_id] = message.t_ns
        elif isinstance(message, LoopClosed):
            self.loop_closures.append(message)
        elif isinstance(message, PointChunk):
            self._take_points(message)
        elif isinstance(message, DepthMap):
            self._pictures.take(message)
            for name, ms in message.kernel_ms.items():
                self._kernel_times.add(name, ms)
        elif isinstance(message, PositionSample):
            times, places = self._positions.setdefault(message.source, (array("q"), array("d")))
            if not times or message.t_ns - times[-1] >= POSITION_STEP_NS:
                times.append(message.t_ns)
                places.extend(message.position_ned_m.tolist())
        elif isinstance(message, Warned) and not message.good:
            self._warn(message)

    def _take_points(self, chunk: PointChunk) -> None:
        given_up = self._chunks.n_given_up
        self._chunks.put(chunk)
        if len(chunk.points_camera):
            depth = float(np.median(chunk.points_camera[:, 2]))
            self._median_depths[chunk.keyframe_id] = depth
        if self._chunks.n_given_up > given_up:
            self._warn(Warned(chunk.t_ns, GIVEN_UP))

    def _warn(self, message: Warned) -> None:
        warnings = self.warnings.get(message.what)
        if warnings is None:
            self.warnings[message.what] = WarningCount(1, message.t_ns, message.detail)
        else:
            warnings.count += 1

    def close(self) -> None:
        """Free the points, and the file that holds them."""
        self._chunks.close()

    @property
    def georeference(self) -> Georeference | None:
        """Georeference of the map; None without a scale."""
        return self.update.georeference if self.update is not None else None

    @property
    def unit(self) -> str:
        """Unit of lengths: m, or map units without a scale."""
        return "m" if self.georeference is not None else "map units"

    @property
    def n_keyframes(self) -> int:
        """Keyframes of the final map."""
        return self.update.n_keyframes if self.update is not None else 0

    @property
    def n_points(self) -> int:
        """Points of all keyframes, before voxel filtering."""
        return self._chunks.n_points

    @property
    def n_depth_maps(self) -> int:
        """Number of depth maps."""
        return self._pictures.n_seen

    def kernel_times(self) -> dict[str, dict[str, float]]:
        """Time of each kernel per depth map, in the form of `StageTimes.summary()`."""
        return self._kernel_times.summary()

    @property
    def tracks(self) -> list[Track]:
        """One track per frame, in order of frames, with poses relative to keyframes."""
        return list(self._tracks)

    def poses(self) -> list[WorldPose]:
        """Poses of all localised frames, in order, by the final map."""
        out = []
        for track in self._tracks:
            if track.keyframe_id is None or track.keyframe_from_camera is None:
                continue
            place = self.update.place_of(track.keyframe_id) if self.update is not None else None
            if place is None:
                continue
            pose = place.apply_to_pose(track.keyframe_from_camera)
            if self.georeference is not None:
                pose = self.georeference.world_from_map.apply_to_pose(pose)
            out.append(WorldPose(track.seq, track.t_ns, pose))
        return out

    def keyframes(self) -> list[tuple[int, int | None, Pose]]:
        """Keyframes placed by the final map: number, t_ns (None where unknown), world_from_camera.

        Redundant ones that have left the map are among them, where their neighbours carried them.
        """
        if self.update is None:
            return []
        out = []
        for keyframe_id in sorted(self.update.map_from_camera):
            place = self.update.place_of(keyframe_id)
            assert place is not None
            pose = place.apply_to_pose(Pose.identity())
            if self.georeference is not None:
                pose = self.georeference.world_from_map.apply_to_pose(pose)
            out.append((keyframe_id, self._keyframe_t_ns.get(keyframe_id), pose))
        return out

    def cloud(self, voxel_m: float) -> Cloud:
        """All chunks in the world, one point per voxel of side `voxel_m`.

        Without a scale the side is a hundredth of the median depth. The result does not depend on
        the order in which chunks came.
        """
        gathering = self.gather_cloud(voxel_m)
        while True:
            try:
                next(gathering)
            except StopIteration as over:
                cloud: Cloud = over.value
                return cloud

    def gather_cloud(self, voxel_m: float) -> Generator[float, None, Cloud]:
        """The same in slices, for a caller with other work: yields progress, 0 to 1.

        Uses the keyframe poses at its beginning; chunks that come meanwhile are left out.
        """
        update, georeference = self.update, self.georeference
        if update is None:
            return no_cloud()
        places: dict[int, Similarity] = {}
        for keyframe_id in self._chunks.keyframe_ids:
            place = update.place_of(keyframe_id)
            if place is None or keyframe_id not in self._median_depths:
                continue
            places[keyframe_id] = georeference.world_from_map @ place if georeference else place
        if not places:
            return no_cloud()
        metric = georeference is not None
        depths = [place.scale * self._median_depths[key] for key, place in places.items()]
        voxel = voxel_m if metric else VOXEL_PER_DEPTH * float(np.median(depths))
        local_scales: dict[int, float] = {}
        parts = [partial(self._placed, k, p, update, local_scales) for k, p in places.items()]
        return (yield from gathered(parts, self.n_points, voxel))

    def _placed(
        self, keyframe_id: int, place: Similarity, update: MapUpdate, local_scales: dict[int, float]
    ) -> Cloud:
        """Points of a chunk in the world; none where the disk was full."""
        if keyframe_id not in self._chunks:
            return no_cloud()
        chunk = self._chunks.get(keyframe_id)
        if keyframe_id not in local_scales:
            local_scales[keyframe_id] = _local_scale(chunk, update)
        return placed(chunk, replace(place, scale=local_scales[keyframe_id] * place.scale))

    def autopilot_path(self) -> tuple[PositionSource, Array, Array] | None:
        """Path of the autopilot by its best source: t_ns (N,), NED metres (N, 3)."""
        for source in PositionSource:
            times, places = self._positions.get(source, (array("q"), array("d")))
            if len(times) >= 2:
                return source, np.array(times), np.array(places).reshape(-1, 3)
        return None

    def depth_pictures(self, n: int) -> list[DepthPicture]:
        """At most `n` pictures of depth maps, spread over the flight."""
        return self._pictures.spread(n)


def _local_scale(chunk: PointChunk, update: MapUpdate) -> float:
    """Local scale correction of a chunk in the newest map; by spans where points are few."""
    place = update.place_of(chunk.keyframe_id)
    if place is None:
        return 1.0
    in_camera = place.inverse().apply(update.points_map)
    ratio = local_scale_of_points(chunk.points_camera.astype(np.float64), in_camera)
    return update.local_scale_of(chunk.keyframe_id, chunk.spans) if ratio is None else ratio
