"""The tracking state machine: every frame gets a pose, or an honest LOST.

Initialising (two views) -> tracking (project the local map, refine) -> lost (match keyframes) and
back. Knows no clock: times come with the frames, durations are measured by whoever hands in
`times`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from companion.config import Config
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose, angle_between
from companion.messages import Frame, KeyframeAdded, LoopClosed, Track, TrackState
from companion.slam.features.orb_features import FeatureExtractor, Features
from companion.slam.features.view import View
from companion.slam.initialisation.bootstrap import Bootstrap, Start
from companion.slam.initialisation.map_continuation import Bridge, bridge
from companion.slam.map.reports import keyframe_added, track_of
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.mapping.atlas import MAX_YOUNG_KEYFRAMES, Atlas
from companion.slam.mapping.mapping_worker import AtOnce, Beside, Done, MappingWorker, MapTurn
from companion.slam.tracking.frame_tracker import Placer
from companion.slam.tracking.keyframe_choice import covering, keyframe_of, wants_keyframe
from companion.slam.tracking.map_start import begin_map, carry_on, place_earlier
from companion.timing.clock import Timer

MAX_TURN_UNSEEN_RAD = np.radians(15.0)
TOLD_RESTART_SHARE = 0.4
"""With attitude two views are surer to fit together, and another map may begin so much sooner."""
MIN_FIRM, MIN_FIRM_SHARE = 25, 0.2
"""Without attitude a guess is believed when so many points of the last frame are found by it."""
PARALLAX_RATIO = 1.5
"""So much more parallax is asked for each time that a map turned out wrong."""
Told = Track | KeyframeAdded | LoopClosed


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """What is believed of a frame before its image is looked at.

    `map_from_camera` predicted pose or None; `ned_from_camera` rotation by the autopilot or None,
    and `map_from_camera_rotation` the same in the map's axes, which may be some degrees off level.
    """

    map_from_camera: Pose | None
    ned_from_camera: Array | None
    map_from_camera_rotation: Array | None = None


class Tracker:
    """Frames and priors in; Tracks and KeyframeAdded out.

    With `beside` the map is extended in another thread, and keyframes are told of when they are
    done; without it each is done within its frame.
    """

    def __init__(self, config: Config, camera: Camera, times: Timer, beside: bool = False) -> None:
        self._config = config.tracking
        self._camera = camera
        self._times = times
        self._extractor = FeatureExtractor(config.features, camera)
        self._next_keyframe_id = 0
        self.turn = MapTurn()
        """Taken by whoever else looks at the map."""
        self.atlas = Atlas(config.features, config.mapping, camera, self.turn, beside)
        self._worker: MappingWorker = Beside(self.turn, self.atlas.catch_up) if beside else AtOnce()
        self._placer = Placer(self._config, camera, self.atlas)
        self.state = TrackState.INITIALISING
        self._bootstrap = Bootstrap(self._config, camera)
        self._lost_since_ns: int | None = None
        self._forget()

    @property
    def map(self) -> SlamMap:
        """The map in use."""
        return self.atlas.map

    @property
    def segments(self) -> list[SlamMap]:
        """Maps that stand for themselves: one more each time a lost camera had to begin anew."""
        return self.atlas.segments

    def _forget(self) -> None:
        """Another map is in use: what was known of the last frame is not of it."""
        self._last: View | None = None
        self._ashore: View | None = None
        """The last frame that was tracked before the camera was lost, where none tells its turns"""
        self._reference: Keyframe | None = None
        self._covered_ns: int | None = None
        """Since when the reference, an older keyframe, has been showing what frames do"""
        self._placer.forget()

    def step(self, frame: Frame, prior: Prior) -> list[Told]:
        """Take one frame, while it is the tracker's turn; frames come in order of time."""
        with self._times("features"):
            features = self._extractor.extract(frame.grey)
        return self._place_frame(frame, features, prior) + self._worker.done()

    def take_up(self, kept: SlamMap, next_keyframe_id: int, until_ns: int) -> None:
        """Begin lost, in a map from before; to be called before the first frame.

        Until a time no other map begins.
        """
        self.atlas.take_up(kept)
        self._forget()
        self._reference = kept.keyframes[max(kept.keyframes)]
        self._next_keyframe_id = next_keyframe_id
        self.state, self._lost_since_ns = TrackState.LOST, until_ns

    def leave(self, first_keyframe_id: int) -> None:
        """Let go of a map; where it is the one in use another begins."""
        if self.atlas.leave(first_keyframe_id):
            self._forget()
            self._bootstrap = Bootstrap(self._config, self._camera)
            self.state, self._lost_since_ns = TrackState.INITIALISING, None

    @property
    def next_keyframe_id(self) -> int:
        """None so far had this number."""
        return self._next_keyframe_id

    def set_effort(self, share: float) -> None:
        """Look for this share of the features from now on."""
        self._extractor.effort = share

    def begin_anew(self, number: int, keep: bool) -> None:
        """Give up the map in use, which is wrong, for the `number`th time in a row.

        What was mapped stays behind as a map of its own with `keep`. To be called in the tracker's
        turn.
        """
        self.atlas.give_up(keep)
        self._forget()
        self.state, self._lost_since_ns = TrackState.INITIALISING, None
        self._bootstrap = Bootstrap(
            self._config, self._camera, min_parallax_ratio=PARALLAX_RATIO**number
        )

    def close(self) -> Done:
        """Finish the mapping that is under way; what it gave."""
        self._worker.close()
        return self._worker.done()

    def _place_frame(self, frame: Frame, features: Features, prior: Prior) -> list[Told]:
        if self.state is TrackState.INITIALISING:
            return self._initialise(frame, features, prior)
        view = View(
            frame.seq, frame.t_ns, features, prior.ned_from_camera, frame.grey,
            Pose.identity(), np.full(len(features), -1),
        )  # fmt: skip
        view.map_from_camera_rotation = prior.map_from_camera_rotation
        with self._times("tracking"):
            found = self._track(view, prior)
        if not found:
            return self._lost(frame, features, prior)
        self.state = TrackState.TRACKING
        self._lost_since_ns = None
        self._last = view
        if not self._worker.busy and self._wants_keyframe(view):
            self._insert(view)
        assert self._reference is not None
        return [track_of(self.map, view, self._reference)]

    # -- initialising ---------------------------------------------------------------------------

    def _initialise(self, frame: Frame, features: Features, prior: Prior) -> list[Told]:
        with self._times("initialising"):
            start = self._bootstrap.step(frame, features, prior.ned_from_camera)
        across = None
        if start is not None and self._ashore is not None:
            across = bridge(self.map, self._ashore, start)
        if start is not None and across is not None:
            return self._go_on(start, across)
        told = prior.ned_from_camera is not None
        if start is None or not self._given_up(frame.t_ns, told):
            return [Track(frame.seq, frame.t_ns, self.state)]
        self.atlas.begin(level=start.first.ned_from_camera is not None)
        self._forget()
        with self._times("mapping"):
            first, second = self._keyframe(start.first), self._keyframe(start.second)
            self._reference, self._last = second, start.second
            begin_map(self.atlas, start, first, second)
        self._placer.refresh_local(start.second)
        self.state, self._lost_since_ns = TrackState.TRACKING, None
        out = self._placed_earlier(start.first, start.second, first)
        out += [track_of(self.map, start.second, second)]
        out += [keyframe_added(self.map, first), keyframe_added(self.map, second)]
        return out

    def _go_on(self, start: Start, across: Bridge) -> list[Told]:
        """Take two views into the map that the first of them was the last to be tracked in."""
        assert self._ashore is not None
        ashore, view = self._ashore, start.second
        first = self._keyframe(ashore)
        carry_on(self.atlas, ashore, first, start, across)
        self._last, self._ashore = view, None
        self._placer.refresh_local(view)
        second = self._insert(view)
        between = self._placed_earlier(ashore, view, first)
        self.state, self._lost_since_ns = TrackState.TRACKING, None
        return [keyframe_added(self.map, first), *between, track_of(self.map, view, second)]

    def _placed_earlier(self, first: View, second: View, reference: Keyframe) -> list[Told]:
        views = place_earlier(self._placer, self._bootstrap.pending, first, second, reference)
        return [track_of(self.map, view, reference, backfilled=True) for view in views]

    # -- tracking -------------------------------------------------------------------------------

    def _track(self, view: View, prior: Prior) -> bool:
        placer = self._placer
        if placer.sees_too_little(view):
            return False
        last, found = self._last, False
        if prior.map_from_camera is not None and last is not None:
            guess = prior.map_from_camera.inverse()
            recent = last.point_ids[last.point_ids >= 0]
            recent = recent[self.map.alive[recent]]
            turn_known = prior.ned_from_camera is not None
            firm = 0 if turn_known else max(MIN_FIRM, int(MIN_FIRM_SHARE * len(recent)))
            found = placer.match(view, guess, recent, 15.0, at_least=firm)
            if not found and not turn_known:
                # how far the camera turned is anybody's guess: ask the descriptors first
                found = self._by_reference(view)
            found = found or placer.match(view, guess, recent, 40.0, at_least=firm)
            found = found or placer.match(view, guess, placer.local, 25.0, at_least=firm)
            if not found and turn_known:
                found = self._by_reference(view)
                if not found and self.state is TrackState.TRACKING:
                    found = placer.follow(view, guess, last)
        if not found and not self._relocalise(view):
            return False
        placer.refresh_local(view)
        if not placer.match(view, view.camera_from_map, placer.local, 5.0, count=True):
            return False
        placer.refine(view)
        return _believable(view, prior)

    def _by_reference(self, view: View) -> bool:
        reference = self._reference
        if self.state is not TrackState.TRACKING or reference is None:
            return False
        return self._placer.locate_by(view, reference)

    def _relocalise(self, view: View) -> bool:
        """By any keyframe of any map; the map is then the one in use."""
        found = self.atlas.find(view.features, view.level_from_camera, view.seq)
        if found is None:
            return False
        segment, located = found
        if segment is not self.map:
            self.atlas.use(segment)
            self._forget()
            self._reference = located.keyframe
        return self._placer.accept(view, located)

    def _given_up(self, t_ns: int, told: bool) -> bool:
        """Whether the map in use has been out of sight for so long that another may begin."""
        since = self._lost_since_ns
        if since is not None and t_ns < since:
            return False  # one from before is looked for
        if since is None or len(self.map.keyframes) <= MAX_YOUNG_KEYFRAMES:
            return True
        wait_s = self._config.restart_after_s * (TOLD_RESTART_SHARE if told else 1.0)
        return t_ns - since > wait_s * 1e9

    def _lost(self, frame: Frame, features: Features, prior: Prior) -> list[Told]:
        """Note the loss, and see whether this frame could begin a new map."""
        if self.state is TrackState.TRACKING:
            self._lost_since_ns = frame.t_ns
            last = self._last
            self._ashore = last if last is not None and last.ned_from_camera is None else None
            start = self._ashore
            if start is not None:
                start = replace(start, point_ids=np.full(len(start.features), -1))
            self._bootstrap = Bootstrap(self._config, self._camera, start)
        self.state = TrackState.LOST
        return self._initialise(frame, features, prior)

    # -- keyframes ------------------------------------------------------------------------------

    def _wants_keyframe(self, view: View) -> bool:
        """Whether no keyframe shows what a view does; one that does is referred to from now on."""
        reference = self._reference
        if reference is not None and reference.keyframe_id not in self.map.retired:
            since_ns = reference.t_ns if self._covered_ns is None else self._covered_ns
            if not wants_keyframe(self._config, self.map, reference, view, since_ns):
                return False
        cover = covering(self._config, self.map, view)
        if cover is None:
            return True
        self._reference, self._covered_ns = cover, view.t_ns
        return False

    def _insert(self, view: View) -> Keyframe:
        keyframe = self._keyframe(view)
        features = np.flatnonzero(view.point_ids >= 0)
        self.map.observe(keyframe, features, view.point_ids[features])
        self._reference, self._covered_ns = keyframe, None
        slam_map = self.map

        def extend() -> Done:
            with self._times("mapping"):
                reunited = self.atlas.extend(slam_map, keyframe)
            added = keyframe_added(slam_map, keyframe)
            return [added] if reunited is None else [added, reunited]

        self._worker.submit(extend)
        # already adjusted, where it was done at once
        view.camera_from_map = keyframe.camera_from_map
        view.point_ids = keyframe.point_ids.copy()
        return keyframe

    def _keyframe(self, view: View) -> Keyframe:
        keyframe = keyframe_of(view, self._next_keyframe_id)
        self._next_keyframe_id += 1
        return keyframe


def _believable(view: View, prior: Prior) -> bool:
    """Whether the attitude allows a pose: no camera turns so far unseen by the autopilot."""
    if prior.map_from_camera is None or prior.ned_from_camera is None:
        return True
    off_rad = angle_between(prior.map_from_camera.rotation, view.camera_from_map.rotation.T)
    return off_rad < float(MAX_TURN_UNSEEN_RAD)
