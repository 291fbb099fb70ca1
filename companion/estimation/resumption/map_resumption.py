"""The map kept for the next process, and that of the one before: verified, resumed or dropped."""

from __future__ import annotations

from companion.config import FeaturesConfig
from companion.estimation.attitude.camera_attitude import CameraAttitude
from companion.estimation.camera_motion import CameraMotion
from companion.estimation.gate.proof import MAP_RESUMED
from companion.estimation.georeference.segment_georeference import SegmentGeoreferences
from companion.estimation.odometry.smooth_odometry import SmoothOdometry
from companion.estimation.resumption.checkpoint import MAX_BYTES, Checkpoint
from companion.estimation.resumption.map_verification import Resumption, Verdict
from companion.geometry.camera import Camera
from companion.messages import TrackState, Warned
from companion.slam.map.map_part import map_of, part_around
from companion.slam.map.site_map import of_this_flight
from companion.slam.tracking.tracker import Tracker

MAP_NOT_RECOGNISED = "old map not recognised: new map"


class MapResumption:
    """Checkpoints of what localisation knows: given, and taken up again.

    All but `keep` is called with the map lock held.
    """

    def __init__(
        self, camera: Camera, features: FeaturesConfig, tracker: Tracker, attitude: CameraAttitude,
        motion: CameraMotion, georeferences: SegmentGeoreferences, odometry: SmoothOdometry,
    ) -> None:  # fmt: skip
        self._camera, self._features, self._tracker = camera, features, tracker
        self._attitude, self._motion = attitude, motion
        self._georeferences, self._odometry = georeferences, odometry
        self._trying: Resumption | None = None
        """While a stored map is being verified."""

    def keep(self, t_ns: int) -> Checkpoint | None:
        """State to resume from; None unless the last frame, at this time, was tracked.

        A copy. None while a stored map is being verified, and with a scale while attitude, needed
        for verification, is missing.
        """
        last, segment = self._motion.last, self._tracker.map
        if self._trying is not None or last is None or last.map_from_camera is None:
            return None
        if last.t_ns != t_ns or self._tracker.state is not TrackState.TRACKING:
            return None
        attitude, georeference = self._attitude.at(last.t_ns), self._georeferences.of(segment)
        mounted = self._camera.body_from_camera is not None
        if georeference is not None and mounted and attitude is None:
            return None
        with self._tracker.map_lock.reading():
            place = last.map_from_camera.translation
            (nearest,) = segment.nearest(place, 1, set())
            part = part_around(segment, segment.keyframes[nearest], MAX_BYTES)
        mount, delay_ns = self._attitude.correction
        return Checkpoint(
            last.t_ns, part, self._tracker.keyframes.next_id,
            None if attitude is None else attitude @ last.map_from_camera.rotation.T, georeference,
            self._odometry.state if georeference is not None else None, mount, delay_ns,
        )  # fmt: skip

    def begin(self, kept: Checkpoint, t_ns: int, absent_ns: int) -> None:
        """Start with a stored map, to be verified; before the first frame, at `t_ns`.

        Its scale and georeference are used once several frames agree. Its last frame was
        `absent_ns` ago. Where there is a map of an earlier flight, the stored one is looked for in
        that again, of which it holds a small part at most.
        """
        shift_ns = t_ns - absent_ns - kept.t_ns  # clocks of two processes may differ
        features = self._features
        part = (of_this_flight(kept.part) if self._tracker.atlas.site else None) or kept.part
        segment = map_of(part, features.scale_factor, features.n_levels, shift_ns)
        segment.alive[: segment.n_points] &= segment.n_observers[: segment.n_points] > 0
        self._trying = Resumption(kept, t_ns, absent_ns)
        attitude = {k.keyframe_id: k.ned_from_camera for k in kept.part.keyframes}
        self._attitude.resume(kept.body_from_camera, kept.delay_ns, attitude)
        self._tracker.resume(segment, kept.next_keyframe_id, self._trying.until_ns)

    def frame(self, t_ns: int) -> Warned | None:
        """Verify the stored map by a frame; MAP_RESUMED or MAP_NOT_RECOGNISED once that is over."""
        resumption, last = self._trying, self._motion.last
        if resumption is None:
            return None
        if last is not None and last.t_ns != t_ns:
            last = None
        kept, segment = resumption.kept, self._tracker.map
        in_use = segment.first_keyframe_id == kept.part.first_keyframe_id
        verdict = Verdict.REFUSED
        if in_use:
            attitude = self._attitude.at(t_ns)
            verdict = resumption.check(t_ns, last, attitude, self._camera.camera_from_body)
        if verdict is Verdict.TRYING:
            return None
        self._trying = None
        if verdict is Verdict.REFUSED:
            self._tracker.drop_map(kept.part.first_keyframe_id)
            if in_use:
                self._motion.reset()
                self._attitude.reset()
            return Warned(t_ns, MAP_NOT_RECOGNISED, resumption.why_not)
        if kept.georeference is not None:
            self._georeferences.resume(segment, kept.georeference)
            if kept.odometry is not None:
                self._odometry.resume(segment.first_keyframe_id, kept.georeference, kept.odometry)
        away_s = resumption.absent_ns * 1e-9
        return Warned(
            t_ns, MAP_RESUMED, f"its last frame was {away_s:.1f} s before the first", True
        )
