"""The tracking state machine: every frame gets a pose, or an honest LOST.

Initialising (two views) -> tracking (project the local map, refine) -> lost (match keyframes) and
back. Knows no clock: times come with the frames, durations are measured by whoever hands in
`times`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from companion.camera import Camera
from companion.clock import Timer
from companion.config import Config
from companion.geometry import Array, Pose, angle_between
from companion.messages import Frame, KeyframeAdded, Reunited, Track, TrackState
from companion.slam.atlas import MAX_YOUNG_KEYFRAMES, Atlas
from companion.slam.bootstrap import Bootstrap, Start
from companion.slam.bridge import Bridge, bridge
from companion.slam.features import FeatureExtractor, Features, Ints
from companion.slam.local_map import Projector, local_points
from companion.slam.map import Keyframe, SlamMap
from companion.slam.patches import image_levels
from companion.slam.pose_refinement import other_pose, refine_pose, robust_cost
from companion.slam.refinement import refine_features
from companion.slam.relocalizer import Located
from companion.slam.view import View
from companion.slam.worker import AtOnce, Beside, Done, MappingWorker, MapTurn

MOST_REFINED = 150
"""Points laid over each image by their patches: no pose needs more of them, and they take time."""
MAX_TURN_UNSEEN_RAD = np.radians(15.0)
MIN_FIRM, MIN_FIRM_SHARE = 25, 0.2
"""Without attitude a guess is believed when so many points of the last frame are found by it."""
MIN_DUE_SHARE, ENOUGH = 0.08, 30
"""Without attitude what is found is at least this share of what should be seen, or so many."""
Told = Track | KeyframeAdded | Reunited


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
        self._projector = Projector(camera)
        self._next_keyframe_id = 0
        self.turn = MapTurn()
        """Taken by whoever else looks at the map."""
        self.atlas = Atlas(config.features, config.mapping, camera, self.turn, beside)
        self._worker: MappingWorker = (
            Beside(self.turn, self.atlas.catch_up) if beside else AtOnce()
        )
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
        self._local: Ints = np.zeros(0, np.int64)

    def step(self, frame: Frame, prior: Prior) -> list[Told]:
        """Take one frame, while it is the tracker's turn; frames come in order of time."""
        with self._times("features"):
            features = self._extractor.extract(frame.grey)
        return self._place_frame(frame, features, prior) + self._worker.done()

    def set_effort(self, share: float) -> None:
        """Look for this share of the features from now on."""
        self._extractor.effort = share

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
        return [self._report(view)]

    # -- initialising ---------------------------------------------------------------------------

    def _initialise(self, frame: Frame, features: Features, prior: Prior) -> list[Told]:
        with self._times("initialising"):
            start = self._bootstrap.step(frame, features, prior.ned_from_camera)
        across = None
        if start is not None and self._ashore is not None:
            across = bridge(self.map, self._ashore, start)
        if start is not None and across is not None:
            return self._go_on(start, across)
        if start is None or not self._given_up(frame.t_ns):
            return [Track(frame.seq, frame.t_ns, self.state)]
        self.atlas.begin(level=start.first.ned_from_camera is not None)
        self._forget()
        with self._times("mapping"):
            first = self._keyframe(start.first)
            second = self._keyframe(start.second)
            assert second.grey is not None
            ids = self.map.add_points(
                start.points_map, second, start.features_second, image_levels(second.grey)
            )
            self.map.first_keyframe_id = first.keyframe_id
            self.map.keyframes[first.keyframe_id] = first
            self.map.poses_changed()
            self.map.observe(first, start.features_first, ids)
            self.map.observe(second, start.features_second, ids)
            self.map.refresh(ids, [first, second])
            self._reference = second
            mapper = self.atlas.mapper
            mapper.add(second)
            mapper.adjust_all(10)
            self.atlas.remember(first)
            self.atlas.remember(second)
        start.second.camera_from_map = second.camera_from_map
        start.second.point_ids = second.point_ids.copy()
        self._last = start.second
        self._refresh_local(start.second)
        self.state, self._lost_since_ns = TrackState.TRACKING, None
        out: list[Told] = [self._backfilled(v, first) for v in self._backfill(first, second)]
        out += [self._report(start.second), _added(self.map, first), _added(self.map, second)]
        return out

    def _go_on(self, start: Start, across: Bridge) -> list[Told]:
        """Take two views into the map that the first of them was the last to be tracked in."""
        assert self._ashore is not None
        slam_map, view = self.map, start.second
        first = self._keyframe(self._ashore)
        tracked = np.flatnonzero(self._ashore.point_ids >= 0)
        tracked = tracked[slam_map.alive[self._ashore.point_ids[tracked]]]
        slam_map.keyframes[first.keyframe_id] = first
        slam_map.poses_changed()
        slam_map.observe(first, tracked, self._ashore.point_ids[tracked])
        ids = slam_map.add_points(
            across.points_map, first, across.features_first, image_levels(self._ashore.grey)
        )
        slam_map.observe(first, across.features_first, ids)
        slam_map.refresh(ids, [first])
        self.atlas.remember(first)
        self._reference, self._last, self._ashore = first, view, None
        view.camera_from_map = across.second_from_map
        view.point_ids = np.full(len(view.features), -1)
        view.point_ids[start.features_second[across.known]] = across.known_points
        view.point_ids[start.features_second[~across.known]] = ids
        self._refresh_local(view)
        self._insert(view)
        assert self._reference is not None
        between = self._backfill(first, self._reference)
        self.state, self._lost_since_ns = TrackState.TRACKING, None
        told: list[Told] = [_added(slam_map, first)]
        told += [self._backfilled(v, first) for v in between]
        return [*told, self._report(view)]

    def _backfill(self, first: Keyframe, second: Keyframe) -> list[View]:
        """Place the frames that came before the map: from the first keyframe outwards."""
        views = [v for v in self._bootstrap.pending if v.seq != second.seq]
        placed: list[View] = []
        before = [v for v in views if v.seq <= first.seq][::-1]
        after = [v for v in views if v.seq > first.seq]
        for run, start, end in ((before, first, None), (after, first, second)):
            pose, misses, last = start.camera_from_map, 0, start.t_ns
            for v in run:
                guess = pose
                if end is not None:
                    share = (v.t_ns - start.t_ns) / max(end.t_ns - start.t_ns, 1)
                    centre = (1 - share) * start.centre + share * end.centre
                    guess = Pose(pose.rotation, -pose.rotation @ centre)
                if self._place(v, guess) or self._locate_by(v, start):
                    pose, misses, last = v.camera_from_map, 0, v.t_ns
                    placed.append(v)
                else:
                    misses += 1
                    if misses > 5 or abs(v.t_ns - last) > 1e9:
                        break
        return sorted(placed, key=lambda v: v.seq)

    def _place(self, view: View, guess: Pose) -> bool:
        if len(view.features) < self._config.min_inliers:
            return False
        view.point_ids = np.full(len(view.features), -1)
        return self._match(view, guess, self._local, 25.0) or self._match(
            view, guess, self._local, 60.0
        )

    # -- tracking -------------------------------------------------------------------------------

    def _track(self, view: View, prior: Prior) -> bool:
        if len(view.features) < self._config.min_inliers:
            return False
        last, found = self._last, False
        if prior.map_from_camera is not None and last is not None:
            guess = prior.map_from_camera.inverse()
            recent = last.point_ids[last.point_ids >= 0]
            recent = recent[self.map.alive[recent]]
            turn_known = prior.ned_from_camera is not None
            firm = 0 if turn_known else max(MIN_FIRM, int(MIN_FIRM_SHARE * len(recent)))
            found = self._match(view, guess, recent, 15.0, at_least=firm)
            if not found and not turn_known:
                # how far the camera turned is anybody's guess: ask the descriptors first
                found = self._by_reference(view)
            found = found or self._match(view, guess, recent, 40.0, at_least=firm)
            found = found or self._match(view, guess, self._local, 25.0, at_least=firm)
            if not found and turn_known:
                found = self._by_reference(view)
        if not found and not self._relocalise(view):
            return False
        self._refresh_local(view)
        if not self._match(view, view.camera_from_map, self._local, 5.0, count=True):
            return False
        self._refine(view)
        return _believable(view, prior)

    def _refine(self, view: View) -> None:
        """Lay the points' patches over the image, and take the pose from where they fit."""
        features = view.features
        normalised, whitening = features.normalised.copy(), features.whitening.copy()
        refined_for = np.full(len(features), -1)
        index = np.flatnonzero(view.point_ids >= 0)
        points = view.point_ids[index]
        some = np.arange(0, len(index), max(1, -(-len(index) // MOST_REFINED)))
        finer, white = normalised[index], whitening[index]
        finer[some], white[some], _ = refine_features(
            self.map, view.camera_from_map, features, index[some], points[some],
            image_levels(view.grey),
        )  # fmt: skip
        normalised[index], whitening[index] = finer, white
        refined_for[index[some]] = points[some]
        view.normalised, view.whitening, view.refined_for = normalised, whitening, refined_for
        positions = self.map.positions[points]
        pose, inlier, information = refine_pose(
            view.camera_from_map, positions, finer, white, rounds=2
        )
        told = view.ned_from_camera is not None
        if not told:
            start = other_pose(positions, finer)
            if start is not None:
                other, theirs, info = refine_pose(start, positions, finer, white)
                if robust_cost(other, positions, finer, white) < robust_cost(
                    pose, positions, finer, white
                ):
                    pose, inlier, information = other, theirs, info
        if inlier.sum() >= max(self._config.min_inliers, 0.5 * len(points)):
            view.camera_from_map, view.information = pose, information
            view.point_ids[index[~inlier]] = -1

    def _match(
        self, view: View, guess: Pose, ids: Ints, radius_px: float, count: bool = False,
        at_least: int = 0,
    ) -> bool:  # fmt: skip
        visible = self._projector.visible(self.map, guess, ids)
        points, found = self._projector.search(self.map, visible, view.features, radius_px)
        if len(points) < self._config.min_inliers:
            return False
        features = view.features
        pose, inlier, information = refine_pose(
            guess, self.map.positions[points], features.normalised[found],
            features.whitening[found], rounds=4 if count else 2,  # at first roughly
        )  # fmt: skip
        n = int(inlier.sum())
        if n < max(self._config.min_inliers, at_least) or n < 0.3 * len(points):
            return False
        told = view.ned_from_camera is not None
        if count and not told and n < min(MIN_DUE_SHARE * len(visible.ids), ENOUGH):
            return False
        view.camera_from_map, view.information = pose, information
        view.point_ids[:] = -1
        view.point_ids[found[inlier]] = points[inlier]
        view.n_matches = len(points)
        if count:
            self.map.n_visible[visible.ids] += 1
            self.map.n_found[points[inlier]] += 1
        return True

    def _by_reference(self, view: View) -> bool:
        reference = self._reference
        if self.state is not TrackState.TRACKING or reference is None:
            return False
        return self._locate_by(view, reference)

    def _locate_by(self, view: View, keyframe: Keyframe) -> bool:
        """As a lost camera would, by what one keyframe shows."""
        located = self.atlas.locate_by(view.features, keyframe, view.level_from_camera, view.seq)
        return located is not None and self._accept(view, located)

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
        return self._accept(view, located)

    def _accept(self, view: View, located: Located) -> bool:
        view.camera_from_map = located.camera_from_map
        view.point_ids[:] = -1
        view.point_ids[located.features] = located.points
        self._refresh_local(view)
        return self._match(view, located.camera_from_map, self._local, 12.0)

    def _refresh_local(self, view: View) -> None:
        seen = view.point_ids[view.point_ids >= 0]
        pose = view.camera_from_map
        self._local = local_points(self.map, seen, -pose.rotation.T @ pose.translation)

    def _given_up(self, t_ns: int) -> bool:
        """Whether the map in use has been out of sight for so long that another may begin."""
        since = self._lost_since_ns
        if since is None or len(self.map.keyframes) <= MAX_YOUNG_KEYFRAMES:
            return True
        return t_ns - since > self._config.restart_after_s * 1e9

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
        reference = self._reference
        if reference is None:
            return True
        config = self._config
        _, ids = self.map.seen_by(reference)
        firm = ids[self.map.n_observers[ids] >= min(3, len(self.map.keyframes))]
        share = view.n_inliers / max(len(firm), 1)
        tracked = view.point_ids[view.point_ids >= 0]
        position = self.map.positions[tracked]
        pose = view.camera_from_map
        here = (-pose.rotation.T @ pose.translation) - position
        there = reference.centre - position
        cosine = (here * there).sum(1) / np.maximum(
            np.linalg.norm(here, axis=1) * np.linalg.norm(there, axis=1), 1e-12
        )
        parallax = float(np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))))
        late = view.t_ns - reference.t_ns > config.keyframe_max_s * 1e9 and parallax > 0.5
        weak = share < config.keyframe_min_share and (parallax > 0.4 or share < 0.5)
        return weak or parallax > config.keyframe_parallax_deg or late

    def _insert(self, view: View) -> None:
        keyframe = self._keyframe(view)
        features = np.flatnonzero(view.point_ids >= 0)
        self.map.observe(keyframe, features, view.point_ids[features])
        self._reference = keyframe
        slam_map = self.map

        def extend() -> Done:
            with self._times("mapping"):
                reunited = self.atlas.extend(slam_map, keyframe)
            added = _added(slam_map, keyframe)
            return [added] if reunited is None else [added, reunited]

        self._worker.submit(extend)
        # already adjusted, where it was done at once
        view.camera_from_map = keyframe.camera_from_map
        view.point_ids = keyframe.point_ids.copy()

    def _keyframe(self, view: View) -> Keyframe:
        keyframe = Keyframe(
            self._next_keyframe_id, view.seq, view.t_ns, view.camera_from_map, view.features,
            np.full(len(view.features), -1),
            view.features.normalised.copy() if view.normalised is None else view.normalised,
            view.features.whitening.copy() if view.whitening is None else view.whitening,
            np.full(len(view.features), -1) if view.refined_for is None else view.refined_for,
            view.grey, None if view.ned_from_camera is None else view.ned_from_camera[2],
        )  # fmt: skip
        self._next_keyframe_id += 1
        return keyframe

    # -- reporting ------------------------------------------------------------------------------

    def _report(
        self, view: View, keyframe: Keyframe | None = None, backfilled: bool = False
    ) -> Track:
        reference = keyframe or self._reference
        assert reference is not None
        map_from_camera = view.camera_from_map.inverse()
        relative = reference.camera_from_map @ map_from_camera
        unit = self.map.unit_of.get(reference.keyframe_id, 1.0)
        return Track(
            view.seq, view.t_ns, TrackState.TRACKING, map_from_camera, reference.keyframe_id,
            Pose(relative.rotation, relative.translation / unit), view.n_inliers, view.n_matches,
            view.features.pixels[view.point_ids >= 0], backfilled, *_sigmas(view),
        )  # fmt: skip

    def _backfilled(self, view: View, first: Keyframe) -> Track:
        return self._report(view, first, backfilled=True)


def _sigmas(view: View) -> tuple[float, float]:
    """Standard deviations by the image alone: of position, map units, and attitude, rad."""
    if view.information is None:
        return float("inf"), float("inf")
    try:
        covariance = np.linalg.inv(view.information)
    except np.linalg.LinAlgError:
        return float("inf"), float("inf")
    variance = np.maximum(np.diag(covariance), 0.0)
    return float(np.sqrt(variance[3:].max())), float(np.sqrt(variance[:3].max()))


def _added(slam_map: SlamMap, keyframe: Keyframe) -> KeyframeAdded:
    _, ids = slam_map.seen_by(keyframe)
    return KeyframeAdded(
        keyframe.keyframe_id, keyframe.seq, keyframe.t_ns, keyframe.camera_from_map.inverse(),
        keyframe.camera_from_map.apply(slam_map.positions[ids]),
    )  # fmt: skip


def _believable(view: View, prior: Prior) -> bool:
    """Whether the attitude allows a pose: no camera turns so far unseen by the autopilot."""
    if prior.map_from_camera is None or prior.ned_from_camera is None:
        return True
    off_rad = angle_between(prior.map_from_camera.rotation, view.camera_from_map.rotation.T)
    return off_rad < float(MAX_TURN_UNSEEN_RAD)
