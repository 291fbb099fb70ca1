"""The camera watched by its images: its shutter and its lens, and how near tracking is to fail."""

from __future__ import annotations

from collections.abc import Iterator

from companion.estimation.attitude.camera_attitude import CameraAttitude
from companion.estimation.camera_motion import CameraMotion
from companion.estimation.inertial.steady_level import SteadyLevel
from companion.estimation.lens.lens_watch import LensWatch
from companion.estimation.odometry.tracking_margin import TrackingMargin
from companion.estimation.shutter.shutter_of_frames import ShutterOfFrames
from companion.geometry.camera import Camera
from companion.messages import Frame, Message, Track, Warned
from companion.slam.tracking.tracker import Tracker
from companion.timing.clock import Timer


class CameraWatch:
    """Frames before they are tracked, tracks of them, and what they show of the camera."""

    def __init__(
        self, camera: Camera, n_features: int, tracker: Tracker, attitude: CameraAttitude,
        motion: CameraMotion, level: SteadyLevel, times: Timer,
    ) -> None:  # fmt: skip
        self._tracker, self._attitude = tracker, attitude
        self._motion, self._times = motion, times
        self._shutter = None if camera.readout_ms == 0 else ShutterOfFrames(camera)
        self._lens = None if camera.gimbal is not None else LensWatch(camera, level)
        self._margin = TrackingMargin(camera, n_features)

    @property
    def near_limits(self) -> bool:
        """True where the last frame that was tracked is near what can be."""
        return self._margin.is_near

    def begin(self, frame: Frame) -> Frame:
        """The frame as a global shutter would have taken it."""
        if self._shutter is None:
            return frame
        with self._times("shutter"):
            return self._shutter.begin(frame, self._attitude, self._motion)

    def of(self, out: Message, seq: int) -> Message:
        """A message of tracking; the track of this frame with the motion of its shutter."""
        if self._shutter is not None and isinstance(out, Track) and out.seq == seq:
            return self._shutter.of(out)
        return out

    def limits(self, track: Track) -> list[Warned]:
        """Warnings where the track of the frame is near the limits of tracking, or away again."""
        tracker = self._tracker
        return self._margin.take(
            track, tracker.view_of(track.seq), tracker.map, tracker.n_features,
            tracker.extractor.feature_ratio, tracker.nearly_drowned,
        )  # fmt: skip

    def end(self, seq: int) -> Iterator[Warned]:
        """Warnings of shutter and lens, once the frame was tracked."""
        view_of, slam_map = self._tracker.view_of, self._tracker.map
        if self._shutter is not None:
            with self._times("shutter"):
                said = self._shutter.end(view_of(seq), slam_map)
            yield from said
        if self._lens is not None and self._lens.watches:
            with self._times("lens"):
                said = self._lens.end(
                    view_of(seq), slam_map, self._attitude.correction[0],
                    self._attitude.imu_delay_ns,
                )  # fmt: skip
            yield from said
