"""The tracking state machine: a pose for every frame, or LOST.

Initialising (two views) -> tracking (project the local map, refine) -> lost (relocalise) and back.
Knows no clock: times come with the frames, durations are measured by the given `times`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from companion.config import Config
from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose
from companion.messages import (
    Bytes,
    Frame,
    KeyframeAdded,
    LoopClosed,
    Track,
    TrackRefined,
    TrackState,
)
from companion.slam.features.faint_pictures import strengthened
from companion.slam.features.features_ahead import FeaturesAhead
from companion.slam.features.orb_features import FeatureExtractor, Features
from companion.slam.features.view import View
from companion.slam.initialisation.bootstrap import Bootstrap, TwoViewReconstruction
from companion.slam.initialisation.map_continuation import MapContinuation, continuation_of
from companion.slam.loop.place_recognition import PlaceBlock
from companion.slam.map.reports import keyframe_added, track_of
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.mapping.atlas import MAX_DISCARDED_KEYFRAMES, Atlas
from companion.slam.mapping.mapping_worker import (
    BackgroundMapping,
    Done,
    MapLock,
    MappingWorker,
    SynchronousMapping,
)
from companion.slam.tracking.frame_tracker import FrameTracker
from companion.slam.tracking.map_start import backfill, continue_map, initialise_map
from companion.slam.tracking.prior import Prior
from companion.slam.tracking.refined_frames import RefinedFrames
from companion.slam.tracking.tracked_keyframes import TrackedKeyframes
from companion.timing.clock import Timer

ATTITUDE_RESTART_RATIO = 0.4
"""With attitude, initialisation is more certain: another map may start this much sooner."""
MIN_PREDICTED_INLIERS, MIN_PREDICTED_RATIO = 25, 0.2
"""Inliers, and their ratio to the points of the last frame, required of a prediction without
attitude."""
PARALLAX_RATIO = 1.5
"""Factor on the required parallax each time that a map was found wrong."""
BACKFILLED_IN_FLIGHT = 25
"""Earlier frames that are tracked where a map begins: two to four milliseconds each, for which the
frame of now waits. The pose gate bridges 200 ms; all 150 of the buffer took 250 to 400."""
TrackerOutput = Track | KeyframeAdded | LoopClosed


class Tracker:
    """Frames and priors in; Track, KeyframeAdded and LoopClosed out.

    With `background` mapping runs in another thread, and keyframes are reported when mapped;
    without it within their frame. `order` is that of a MapLock.
    """

    def __init__(
        self, config: Config, camera: Camera, times: Timer, background: bool = False,
        order: Iterable[int] | None = None,
    ) -> None:  # fmt: skip
        self._config = config.tracking
        self._camera = camera
        self._times = times
        self.extractor = FeatureExtractor(config.features, camera)
        self._ahead = FeaturesAhead(config.features, camera, self.extractor)
        self.n_features = 0
        """Features seen in the last frame."""
        self.nearly_drowned = False
        """True where these may be of noise."""
        self._drowned = False
        self._is_live = background
        self.map_lock = MapLock(order)
        """Lock to be held by all other readers of the map."""
        self.atlas = Atlas(config.features, camera, self.map_lock, background)
        self._worker: MappingWorker = (
            BackgroundMapping(self.map_lock, self.atlas.adjust_pending)
            if background
            else SynchronousMapping()
        )
        self.keyframes = TrackedKeyframes(self.atlas, self._worker, times)
        self._frame_tracker = FrameTracker(self._config, camera, self.atlas)
        self._refined = RefinedFrames()
        self.state = TrackState.INITIALISING
        self._bootstrap = Bootstrap(camera)
        self._lost_since_ns: int | None = None
        self._reset()

    @property
    def map(self) -> SlamMap:
        """The active map."""
        return self.atlas.map

    @property
    def segments(self) -> list[SlamMap]:
        """Maps not connected to each other; one more after each reinitialisation."""
        return self.atlas.segments

    def _reset(self) -> None:
        """Clear the state of the last frame after another map became active."""
        self._last: View | None = None
        self._last_tracked: View | None = None
        """The last frame tracked before loss, where no relative rotation is measured."""
        self.keyframes.reset()
        self._frame_tracker.reset()

    def view_of(self, seq: int) -> View | None:
        """The view of frame `seq`, if that is the last one that was tracked."""
        return self._last if self._last is not None and self._last.seq == seq else None

    def step(self, frame: Frame, prior: Prior) -> list[TrackerOutput]:
        """Process one frame, with the map lock held; frames come in order of time."""
        with self._times("features"):
            features = self._ahead.take(frame.grey)
            strong = strengthened(frame.grey)
            self._drowned, self.nearly_drowned = strong.drowned, strong.nearly_drowned
            frame = replace(frame, grey=strong.patches)
            if features is None:
                features = self.extractor.extract(strong.corners)
        self.n_features = len(features)
        return self._track_frame(frame, features, prior) + self._worker.done()

    def refined(self, is_over: bool = False) -> Iterator[TrackRefined]:
        """Refined poses of earlier frames, with the map lock held; at the end of all that wait."""
        if is_over:
            return self._refined.rest(self.segments)
        return self._refined.due(self.keyframes.next_id, self.segments)

    def look_ahead(self, grey: Bytes) -> None:
        """Extract the features of the image (H, W) of a frame to come in another thread."""
        self._ahead.begin(grey)

    def resume(self, kept: SlamMap, next_keyframe_id: int, until_ns: int) -> None:
        """Start lost in a stored map; before the first frame.

        No other map is initialised until `until_ns`.
        """
        self.atlas.resume(kept)
        self._reset()
        self.keyframes.reference = kept.keyframes[max(kept.keyframes)]
        self.keyframes.next_id = next_keyframe_id
        self.state, self._lost_since_ns = TrackState.LOST, until_ns

    def use_site(self, site: SlamMap, places: Sequence[PlaceBlock]) -> None:
        """Look for the camera in the map of an earlier flight; before the first frame."""
        self.atlas.use_site(site, places)
        self.keyframes.next_id = max(site.keyframes) + 1

    def drop_map(self, first_keyframe_id: int) -> None:
        """Drop a map; where it is active, initialise another."""
        if self.atlas.drop_map(first_keyframe_id):
            self._reset()
            self._bootstrap = Bootstrap(self._camera)
            self.state, self._lost_since_ns = TrackState.INITIALISING, None

    def stand(self) -> None:
        """The next frame is the first view of a map: the camera has not moved up to it."""
        self._bootstrap.restart()

    def reinitialise(self, number: int, keep: bool) -> None:
        """Discard the active map, found wrong for the `number`th time in a row; with the lock held.

        With `keep` it stays as a segment.
        """
        self.atlas.discard_map(keep)
        self._reset()
        self.state, self._lost_since_ns = TrackState.INITIALISING, None
        self._bootstrap = Bootstrap(self._camera, min_parallax_ratio=PARALLAX_RATIO**number)

    def close(self) -> Done:
        """Finish pending mapping; its results."""
        self._ahead.close()
        self.map_lock.end_order()
        self._worker.close()
        joined = [*self.atlas.join_maps(), *self.atlas.close_near_loops()]
        self.atlas.free_index()
        return [*self._worker.done(), *joined]

    def _track_frame(self, frame: Frame, features: Features, prior: Prior) -> list[TrackerOutput]:
        if self.state is TrackState.INITIALISING:
            return self._initialise(frame, features, prior)
        view = View(
            frame.seq, frame.t_ns, features, prior.ned_from_camera, frame.grey,
            Pose.identity(), np.full(len(features), -1),
        )  # fmt: skip
        view.map_from_camera_rotation = prior.map_from_camera_rotation
        with self._times("tracking"):
            found = not self._drowned and self._track(view, prior)
        if not found:
            return self._lost(frame, features, prior)
        self.state = TrackState.TRACKING
        self._lost_since_ns = None
        self._last = view
        keyframes = self.keyframes
        if not self._worker.busy and keyframes.needed(view):
            keyframes.insert(view)
        assert keyframes.reference is not None
        return [self._tracked(view, keyframes.reference)]

    # -- initialising ---------------------------------------------------------------------------

    def _initialise(self, frame: Frame, features: Features, prior: Prior) -> list[TrackerOutput]:
        if self._drowned:
            return [Track(frame.seq, frame.t_ns, self.state)]
        with self._times("initialising"):
            start = self._bootstrap.step(frame, features, prior.ned_from_camera)
        continuation = None
        if start is not None and self._last_tracked is not None:
            continuation = continuation_of(self.map, self._last_tracked, start)
        if start is not None and continuation is not None:
            return self._continue_map(start, continuation)
        has_attitude = prior.ned_from_camera is not None
        if start is None or not self._may_restart(frame.t_ns, has_attitude):
            return [Track(frame.seq, frame.t_ns, self.state)]
        self.atlas.new_map(level=start.first.ned_from_camera is not None)
        self._reset()
        with self._times("mapping"):
            first, second = self.keyframes.new(start.first), self.keyframes.new(start.second)
            self.keyframes.reference, self._last = second, start.second
            initialise_map(self.atlas, start, first, second)
        self._frame_tracker.update_local_map(start.second)
        self.state, self._lost_since_ns = TrackState.TRACKING, None
        out = self._backfilled(start.first, start.second, first)
        out += [track_of(self.map, start.second, second)]
        out += [keyframe_added(self.map, first), keyframe_added(self.map, second)]
        return out

    def _continue_map(
        self, start: TwoViewReconstruction, continuation: MapContinuation
    ) -> list[TrackerOutput]:
        """Insert a reconstruction from the last tracked frame into the active map."""
        assert self._last_tracked is not None
        last_tracked, view = self._last_tracked, start.second
        first = self.keyframes.new(last_tracked)
        continue_map(self.atlas, last_tracked, first, start, continuation)
        self._last, self._last_tracked = view, None
        self._frame_tracker.update_local_map(view)
        second = self.keyframes.insert(view)
        between = self._backfilled(last_tracked, view, first)
        self.state, self._lost_since_ns = TrackState.TRACKING, None
        return [keyframe_added(self.map, first), *between, track_of(self.map, view, second)]

    def _backfilled(self, first: View, second: View, reference: Keyframe) -> list[TrackerOutput]:
        views = backfill(
            self._frame_tracker, self._bootstrap.pending, first, second, reference,
            BACKFILLED_IN_FLIGHT if self._is_live else None,
        )  # fmt: skip
        return [self._tracked(view, reference, backfilled=True) for view in views]

    def _tracked(self, view: View, reference: Keyframe, backfilled: bool = False) -> Track:
        self._refined.add(self.map, view, reference)
        return track_of(self.map, view, reference, backfilled)

    # -- tracking -------------------------------------------------------------------------------

    def _track(self, view: View, prior: Prior) -> bool:
        frame_tracker = self._frame_tracker
        if frame_tracker.too_few_features(view):
            return False
        last, found = self._last, False
        if prior.map_from_camera is not None and last is not None:
            guess = prior.map_from_camera.inverse()
            recent = last.point_ids[last.point_ids >= 0]
            recent = recent[self.map.alive[recent]]
            has_attitude = prior.ned_from_camera is not None
            min_inliers = (
                0
                if has_attitude
                else max(MIN_PREDICTED_INLIERS, int(MIN_PREDICTED_RATIO * len(recent)))
            )
            found = frame_tracker.match(view, guess, recent, 15.0, min_inliers=min_inliers)
            if not found and not has_attitude:
                # the rotation is unknown: match descriptors first
                found = frame_tracker.match_turned(view, guess, last, min_inliers)
                found = found or self._relocalise_by_reference(view)
            found = found or frame_tracker.match(view, guess, recent, 40.0, min_inliers=min_inliers)
            found = found or frame_tracker.match(
                view, guess, frame_tracker.local, 25.0, min_inliers=min_inliers
            )
            if not found and self.state is TrackState.LOST:
                found = frame_tracker.match_around(view, guess, min_inliers)
            if not found and has_attitude:
                found = self._relocalise_by_reference(view)
                if not found and self.state is TrackState.TRACKING:
                    found = frame_tracker.track_klt(view, guess, last)
        if not found and not self._relocalise(view):
            return False
        frame_tracker.update_local_map(view)
        if not frame_tracker.match(
            view, view.camera_from_map, frame_tracker.local, 5.0, count=True
        ):
            return False
        frame_tracker.refine(view)
        return prior.agrees(view.camera_from_map)

    def _relocalise_by_reference(self, view: View) -> bool:
        reference = self.keyframes.reference
        if self.state is not TrackState.TRACKING or reference is None:
            return False
        return self._frame_tracker.relocalise_by(view, reference)

    def _relocalise(self, view: View) -> bool:
        """Relocalise in any map, which becomes the active one once the pose is verified there."""
        found = self.atlas.relocalise(view.features, view.level_from_camera, view.seq)
        if found is None:
            return False
        segment, relocalised = found
        if not self._frame_tracker.verify(view, relocalised, segment):
            return False
        if segment is not self.map:
            self.atlas.switch_to(segment)
            self._reset()
            self.keyframes.reference = relocalised.keyframe
        return True

    def _may_restart(self, t_ns: int, has_attitude: bool) -> bool:
        """True if tracking has been lost for long enough to initialise another map."""
        since = self._lost_since_ns
        if since is not None and t_ns < since:
            return False  # relocalisation in a stored map is still being tried
        if since is None or len(self.map.keyframes) <= MAX_DISCARDED_KEYFRAMES:
            return True
        wait_s = self._config.restart_after_s * (ATTITUDE_RESTART_RATIO if has_attitude else 1.0)
        return t_ns - since > wait_s * 1e9

    def _lost(self, frame: Frame, features: Features, prior: Prior) -> list[TrackerOutput]:
        """Note the loss, and try this frame for initialisation."""
        if self.state is TrackState.TRACKING:
            self._lost_since_ns = frame.t_ns
            last = self._last
            self._last_tracked = last if last is not None and last.ned_from_camera is None else None
            start = self._last_tracked
            if start is not None:
                start = replace(start, point_ids=np.full(len(start.features), -1))
            self._bootstrap = Bootstrap(self._camera, start)
        self.state = TrackState.LOST
        return self._initialise(frame, features, prior)
