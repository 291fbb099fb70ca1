"""Depth stage: depth maps and points from keyframes and the frames around them.

A keyframe waits for some later ones, so that poses are adjusted and views on both sides exist.
Frames are buffered up to a bound.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass

import numpy as np

from companion.config import CloudConfig, DepthConfig
from companion.dense.device_takeover import Devices, TestedEngine
from companion.dense.engine import DepthEngine
from companion.dense.fusion import Fusion, measured_only
from companion.dense.undistortion import Undistortion
from companion.dense.view_selection import MAX_VIEWS
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose, Similarity
from companion.messages import (
    Bytes,
    DepthMap,
    Frame,
    KeyframeAdded,
    MapUpdate,
    Message,
    PointChunk,
    Track,
)
from companion.timing.clock import Timer

LAG_KEYFRAMES = 2
"""Later keyframes waited for, whose frames and adjusted poses are used."""
MAX_FRAMES = 100
LEAST_COLOURED, LAGS = 30, 10
"""Newest frames that may still be told to be keyframes: so many, or twice as many as have come
before one of the last keyframes was told. With two thirds of two cores in use that is after 6
frames of 30/s, and 21 at most; a first keyframe waits for the second of its map."""
FIRST_BASELINE = 0.01
"""Ratio of the median depth: with a short baseline the search is hardly ambiguous."""
N_UPDATES = MAX_VIEWS + 1
"""Frames offered for a depth map: one may be passed over."""


@dataclass(slots=True, eq=False)
class _BufferedFrame:
    grey: Bytes
    rgb: Bytes | None
    """None once it is known that it is no keyframe."""
    track: Track | None = None
    motion: Array | None = None
    """During readout, as its first track has it."""
    is_undistorted: bool = False
    """`grey` is, once it is used, as most frames never are."""


class DepthStage:
    """Frames, tracks, keyframes and map updates in; DepthMaps and PointChunks out.

    A Warned reports failure of the device, and which one replaces it, if any.
    """

    def __init__(
        self,
        config: DepthConfig,
        cloud: CloudConfig,
        camera: Camera,
        devices: Devices,
        times: Timer,
    ) -> None:
        self._config = config
        self._fusion = Fusion(cloud)
        self._undistortion = Undistortion(camera)
        intrinsics = self._undistortion.intrinsics
        self._engine = TestedEngine(
            devices,
            lambda device: DepthEngine(
                device, camera.width, camera.height, intrinsics, config, eager=False
            ),
        )
        self._times = times
        self._frames: OrderedDict[int, _BufferedFrame] = OrderedDict()
        self._coloured: deque[int] = deque()
        """Newest of the frames, which have their colours."""
        self._lags: deque[int] = deque([MAX_FRAMES], LAGS)
        """Frames that came before each of the last keyframes was told."""
        self._newest_seq = 0
        self._waiting: list[KeyframeAdded] = []
        self._update: MapUpdate | None = None
        self._last_reference: int | None = None
        self._load_ratio, self._credit = 1.0, 0.0
        self._half_view_rad = float(np.arctan(0.5 * camera.width / intrinsics.fx))

    def set_share(self, share: float) -> None:
        """Compute depth for only this ratio of the keyframes from now on, 0 to 1."""
        self._load_ratio = share

    def step(self, message: Message) -> list[Message]:
        """Process one message, in order of time."""
        if isinstance(message, Frame):
            if not self._engine.off:
                self._buffer(message)
        elif isinstance(message, Track):
            buffered = self._frames.get(message.seq)
            if buffered is not None:
                if buffered.track is None:
                    buffered.motion = message.shutter_motion
                buffered.track = message
        elif isinstance(message, KeyframeAdded):
            self._waiting.append(message)
            self._lags.append(self._newest_seq - message.seq)
            self._drop_colours(before=message.seq)
        elif isinstance(message, MapUpdate):
            self._update = message
            out: list[Message] = []
            while len(self._waiting) > LAG_KEYFRAMES:
                with self._times("depth"):
                    out += self._process(self._waiting.pop(0))
            return [*self._engine.announced(message.t_ns), *out]
        return []

    def flush(self) -> list[Message]:
        """Process pending keyframes."""
        out: list[Message] = []
        for keyframe in self._waiting:
            with self._times("depth"):
                out += self._process(keyframe)
        self._waiting.clear()
        if self._update is not None:
            out += self._fusion.flush(self._update)
            out += self._engine.announced(self._update.t_ns)
        return out

    def _buffer(self, frame: Frame) -> None:
        # a copy, as its memory is that of the colours, too, which are dropped before it
        self._frames[frame.seq] = _BufferedFrame(frame.grey.copy(), frame.rgb)
        if len(self._frames) > MAX_FRAMES:
            # thin out the older half, except frames of pending keyframes
            needed = {k.seq for k in self._waiting}
            old = list(self._frames)[: MAX_FRAMES // 2]
            for seq in old[::2]:
                if seq not in needed:
                    del self._frames[seq]
        self._coloured.append(frame.seq)
        self._newest_seq = frame.seq
        while len(self._coloured) > max(LEAST_COLOURED, 2 * max(self._lags)):
            self._drop_colours(before=self._coloured[1])

    def _process(self, keyframe: KeyframeAdded) -> list[Message]:
        update, buffered = self._update, self._frames.get(keyframe.seq)
        place = None if update is None else update.place_of(keyframe.keyframe_id)
        if update is None or buffered is None or place is None or len(keyframe.points_camera) < 20:
            return []
        if buffered.rgb is None:
            return []  # a keyframe that was told after a later one, or too late
        z = keyframe.points_camera[:, 2]
        z = z[z > 0]
        if not self._sees_new_area(keyframe, place, float(np.median(z))):
            return []
        near, far = 0.5 * float(np.quantile(z, 0.02)), 2.5 * float(np.quantile(z, 0.98))
        chosen = self._choose(keyframe, update, place, float(np.median(z)))
        if len(chosen) < 3 or not self._scheduled():
            return []
        self._last_reference = keyframe.keyframe_id
        motion = None if buffered.track is None else buffered.track.shutter_motion
        rgb = self._undistortion.image(buffered.rgb, motion)

        def depth(engine: DepthEngine) -> DepthMap:
            engine.begin(self._undistorted(buffered), near, far)
            for seq, current_from_reference in chosen:
                engine.update(self._undistorted(self._frames[seq]), current_from_reference)
            return engine.finish(keyframe.keyframe_id, keyframe.t_ns, rgb)

        found = self._engine.run(keyframe.t_ns, depth)
        self._drop_frames(keyframe)
        if found is None:
            return []
        depth_map = measured_only(found)
        chunks: list[PointChunk] = self._fusion.add(depth_map, update)
        return [depth_map, *chunks]

    def _undistorted(self, buffered: _BufferedFrame) -> Bytes:
        if not buffered.is_undistorted:
            buffered.grey = self._undistortion.image(buffered.grey, buffered.motion)
            buffered.is_undistorted = True
        return buffered.grey

    def _scheduled(self) -> bool:
        """Count a keyframe; True if it is due at the present load ratio."""
        self._credit = min(self._credit + self._load_ratio, 1.0)
        if self._credit < 1.0 - 1e-9:
            return False
        self._credit -= 1.0
        return True

    def _sees_new_area(
        self, keyframe: KeyframeAdded, place: Similarity, median_depth: float
    ) -> bool:
        """True if a keyframe sees enough that the last reference did not."""
        last = self._last_reference
        update = self._update
        before = None if last is None or update is None else update.place_of(last)
        if before is None:
            return True
        relative = before.inverse() @ place
        step = float(np.linalg.norm(relative.translation)) / relative.scale / median_depth
        rotation_rad = float(np.arccos(np.clip(relative.rotation[2, 2], -1, 1)))
        # such a rotation brings a sixth of the image into view
        return step > self._config.reference_step or rotation_rad > 0.35 * self._half_view_rad

    def _choose(
        self, keyframe: KeyframeAdded, update: MapUpdate, place: Similarity, median_depth: float
    ) -> list[tuple[int, Pose]]:
        """Frames in order of use: baselines ascending, alternating sides."""
        candidates = []
        for seq, buffered in self._frames.items():
            track = buffered.track
            if seq == keyframe.seq or track is None or track.keyframe_id is None:
                continue
            other_place = update.place_of(track.keyframe_id)
            if other_place is None or track.keyframe_from_camera is None:
                continue
            relative = place.inverse() @ other_place
            if abs(relative.scale - 1.0) > 1e-9:
                continue  # another segment
            reference_from_current = relative.apply_to_pose(track.keyframe_from_camera)
            baseline = float(np.linalg.norm(reference_from_current.translation)) / median_depth
            rotation_rad = np.arccos(np.clip(reference_from_current.rotation[2, 2], -1, 1))
            if baseline <= self._config.max_baseline and rotation_rad < np.radians(35):
                candidates.append((baseline, seq, reference_from_current.inverse()))
        candidates.sort(key=lambda c: (c[0], c[1]))
        if not candidates:
            return []
        longest = min(self._config.max_baseline, candidates[-1][0])
        targets = np.geomspace(min(FIRST_BASELINE, longest), longest, N_UPDATES)
        chosen, used = [], set()
        for index, target in enumerate(targets):
            side = index % 2
            rank = [
                (
                    abs(np.log(max(b, 1e-6) / target))
                    + (0.15 if (seq > keyframe.seq) != bool(side) else 0),
                    seq,
                    pose,
                )
                for b, seq, pose in candidates
                if seq not in used
            ]
            if not rank:
                break
            _, seq, pose = min(rank, key=lambda r: (r[0], r[1]))
            used.add(seq)
            chosen.append((seq, pose))
        baselines = {seq: b for b, seq, _ in candidates}
        return sorted(chosen, key=lambda c: (baselines[c[0]], c[0]))

    def _drop_colours(self, before: int) -> None:
        """Drop the colours of frames before one, but of pending keyframes.

        They are the larger part of a frame, and only those of keyframes are used.
        """
        pending = {k.seq for k in self._waiting}
        while self._coloured and self._coloured[0] < before:
            seq = self._coloured.popleft()
            if seq in self._frames and seq not in pending:
                self._frames[seq].rgb = None

    def _drop_frames(self, keyframe: KeyframeAdded) -> None:
        """Drop frames older than pending keyframes can use."""
        first_needed = keyframe.seq
        for k in self._waiting[:1]:
            first_needed = min(first_needed, k.seq)
        # keep one keyframe interval: the next references use earlier views too
        span = (self._waiting[0].seq - keyframe.seq) if self._waiting else 0
        oldest = first_needed - max(2 * span, 10)
        for seq in [s for s in self._frames if s < oldest]:
            del self._frames[seq]
