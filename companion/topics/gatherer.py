"""Builds bundles of frames, tracks, keyframes and map changes: only data that depth can use.

Of the frames between two keyframes those are taken that have enough baseline for depth, and no more
than the budget allows: a keyframe that could not have enough of them gets none, so that the next
one has all that it needs. Until the next keyframe tells which frames are needed they wait as JPEG.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import numpy as np

from companion.messages import Frame, KeyframeAdded, MapUpdate, Track, TrackRefined
from companion.timing.rate_limit import RateLimit
from companion.topics.image_jpeg import jpeg_of, without_colour
from companion.topics.keyframe_bundle import Bundle, MapChange, MapChanges, Picture

MOST_WAITING, MOST_WAITING_BYTES = 240, 24 << 20
MOST_PICTURES = 48
MOST_TRACKS = 1000
LEAST_STEP = 0.01
"""Least baseline of frames over the median depth."""
LEAST_FRAMES = 4
"""Frames beside its own that a keyframe needs to get depth."""
SAVED_S = 3.0
"""Time for which unused budget is kept."""
GREY_SHARE = 0.9
"""Size of a grey picture over that of the same in colour."""


class Gatherer:
    """Gives a bundle at each map update; `budget_bytes_s` of 0 is no limit."""

    def __init__(self, run: str, budget_bytes_s: float, jpeg_quality: int) -> None:
        self._run, self._quality = run, jpeg_quality
        self._budget = RateLimit(budget_bytes_s, SAVED_S * budget_bytes_s)
        self.n_dropped = 0
        """Frames useful for depth, dropped for the budget or for capacity."""
        self._frames: OrderedDict[int, tuple[int, bytes]] = OrderedDict()
        self._frame_bytes = 0
        self._tracks: list[Track] = []
        self._refined: list[TrackRefined] = []
        self._keyframes: list[KeyframeAdded] = []
        self._tracked: dict[int, Track] = {}
        self._changes = MapChanges()
        self._number = 0
        self._last_place: tuple[float, ...] | None = None
        self.keyframe_jpegs: dict[int, bytes] = {}
        """Pictures of the keyframes of the last bundle, by keyframe id."""

    def take(
        self, message: Frame | Track | TrackRefined | KeyframeAdded | MapUpdate
    ) -> Bundle | None:
        """Take one message, in the order in which localisation gives it."""
        if isinstance(message, Frame):
            self._wait(message)
        elif isinstance(message, Track):
            self._tracks.append(message)
            if len(self._tracks) >= MOST_TRACKS:  # none is lost while there are no keyframes
                return self._bundle(None)
        elif isinstance(message, TrackRefined):
            self._refined.append(message)  # of frames of such tracks, and no more than these
        elif isinstance(message, KeyframeAdded):
            self._keyframes.append(message)
        else:
            return self._bundle(self._changes.since_last(message))
        return None

    def last(self) -> Bundle:
        """Last bundle of the flight."""
        return self._bundle(None, over=True)

    def _wait(self, frame: Frame) -> None:
        jpeg = jpeg_of(frame.rgb, self._quality)
        self._frames[frame.seq] = (frame.t_ns, jpeg)
        self._frame_bytes += len(jpeg)
        self._budget.refill(frame.t_ns)
        while len(self._frames) > MOST_WAITING or self._frame_bytes > MOST_WAITING_BYTES:
            seq = next(iter(self._frames))
            self._forget(seq)
            self.n_dropped += seq in self._tracked

    def _bundle(self, change: MapChange | None, over: bool = False) -> Bundle:
        for track in self._tracks:
            if track.map_from_camera is not None and track.keyframe_from_camera is not None:
                self._tracked[track.seq] = track
        pictures = self._pictures() if self._keyframes else []
        bundle = Bundle(
            self._run, self._number, pictures, self._tracks, self._refined, self._keyframes, change,
            over,
        )  # fmt: skip
        self._number += 1
        self._tracks, self._refined, self._keyframes = [], [], []
        return bundle

    def _pictures(self) -> list[Picture]:
        """Frames up to the newest keyframe; older ones are taken or dropped."""
        newest = max(keyframe.seq for keyframe in self._keyframes)
        owners = {k.seq: k.keyframe_id for k in self._keyframes if k.seq in self._frames}
        self.keyframe_jpegs = {i: self._frames[seq][1] for seq, i in owners.items()}
        useful = self._spread(sorted(s for s in self._frames if s <= newest), set(owners))
        chosen = self._affordable(useful, set(owners))
        out = []
        for seq in chosen:
            t_ns, jpeg = self._frames[seq]
            if seq not in owners:
                jpeg = without_colour(jpeg, self._quality)
            out.append(Picture(seq, t_ns, jpeg, seq in owners))
            self._budget.take(len(jpeg))
        self.n_dropped += len(useful) - len(chosen)
        for seq in [s for s in self._frames if s <= newest]:
            self._forget(seq)
        self._tracked = {s: t for s, t in self._tracked.items() if s > newest}
        return out

    def _spread(self, seqs: Sequence[int], keyframes: set[int]) -> list[int]:
        """Frames with enough baseline between them; keyframes always."""
        depths = np.concatenate([k.points_camera[:, 2] for k in self._keyframes])
        step = LEAST_STEP * float(np.median(depths)) if len(depths) else 0.0
        out = []
        for seq in seqs:
            track = self._tracked.get(seq)
            if track is None or track.map_from_camera is None:
                if seq in keyframes:
                    out.append(seq)
                continue
            place = tuple(map(float, track.map_from_camera.translation))
            if (
                seq in keyframes or self._last_place is None
                or float(np.linalg.norm(np.subtract(place, self._last_place))) >= step
            ):  # fmt: skip
                out.append(seq)
                self._last_place = place
        return out

    def _affordable(self, seqs: list[int], keyframes: set[int]) -> list[int]:
        """Frames within the budget, evenly spread."""
        others = [seq for seq in seqs if seq not in keyframes]
        capacity = MOST_PICTURES - len(keyframes)
        if self._budget.per_s and others:
            own_bytes = sum(len(self._frames[seq][1]) for seq in keyframes)
            each_bytes = GREY_SHARE * float(np.mean([len(self._frames[s][1]) for s in others]))
            capacity = min(capacity, int((self._budget.left - own_bytes) / each_bytes))
            if capacity < min(LEAST_FRAMES, len(others)):
                return []
        if len(others) > capacity:
            kept = np.unique(np.linspace(0, len(others) - 1, max(capacity, 0)).astype(int))
            others = [others[k] for k in kept]
        return sorted([*others, *keyframes])

    def _forget(self, seq: int) -> None:
        _, jpeg = self._frames.pop(seq)
        self._frame_bytes -= len(jpeg)
