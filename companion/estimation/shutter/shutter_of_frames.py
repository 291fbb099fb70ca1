"""The shutter of the camera: rolling frames become those of a global one, and it is watched.

A readout that is not known, or is stated wrongly, is found by what the images show, and said.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from companion.estimation.attitude.camera_attitude import CameraAttitude
from companion.estimation.camera_motion import CameraMotion
from companion.estimation.shutter.readout_estimation import ReadoutEstimator
from companion.geometry.camera import Camera
from companion.geometry.rolling_shutter import Unrolling, shutter_motion
from companion.geometry.transforms import Array
from companion.messages import Frame, Track, Warned
from companion.slam.features.view import View
from companion.slam.map.sparse_map import SlamMap

MIN_POINTS = 30
ROUNDS = 5
HUBER_RATIO = 0.1
"""Least scale of the weights, of the median inverse depth."""
LEAST_HALF_SPAN_NS = 10_000_000
"""Attitudes are rounded, and stamped to a millisecond or two: over less their difference is mostly
that. In such a time a drone turns steadily."""
NOTICED_S, MAX_SIGMA_RATIO = 0.004, 0.1
"""Readout beyond the one that is stated that is said, and the largest ratio of its standard
deviation to it. At 100 degrees/s 4 ms are 0.2 degrees at the top and the bottom of the image."""
SURE_SIGMAS = 3.0
"""Of a readout that is smaller than what is said by so many standard deviations nothing will be:
the watch, half a millisecond a frame, ends."""

BY_IMAGES = "rolling shutter is undone by the rotation between images alone"
BY_IMAGES_WHY = (
    "the autopilot's attitude is not that of the camera, or none comes: quick starts and stops of "
    "a turn are undone late"
)
ROLLING = "looks like a rolling shutter: set camera.readout_ms"
OTHER_READOUT = "the rolling shutter looks slower or faster than camera.readout_ms"


class ShutterOfFrames:
    """Undoes the motion of the camera while a frame is read out.

    Its rotation by the autopilot's attitude, or where that is not the camera's by that between the
    last two images, which is said once; while neither is known a frame stays as it is. Its way
    before a plane through the points of the last frame, where that was tracked. Without a readout
    frames stay as they are, and only the shutter is watched.
    """

    def __init__(self, camera: Camera) -> None:
        self._readout_ms = camera.readout_ms or 0.0
        self._unrolling = (
            Unrolling(camera, 1e-3 * self._readout_ms) if self._readout_ms > 0 else None
        )
        self._half_span_ns = max(round(0.5e6 * self._readout_ms), LEAST_HALF_SPAN_NS)
        self._estimator = ReadoutEstimator(camera.height)
        self._map: SlamMap | None = None
        self._rates: Array | None = None
        self._motion: Array | None = None
        self._last: Array | None = None
        """Points (N, 3) of the map that the last frame saw."""
        self._warnings: list[Warned] = []
        self._said_by_images = False
        self.watches = True
        """False once the readout is known: nothing that comes later would be said."""

    def begin(self, frame: Frame, attitude: CameraAttitude, motion: CameraMotion) -> Frame:
        """The frame as a global shutter would have taken it."""
        self._motion = None
        if self._unrolling is None and not self.watches:
            return frame
        rates = attitude.rates_at(frame.t_ns, self._half_span_ns)
        by_images = rates is None
        if by_images:
            rates = motion.rates_camera_rad_s
        self._rates = None if rates is None or not np.isfinite(rates).all() else rates
        if self._unrolling is None or self._rates is None:
            return frame
        if by_images and not self._said_by_images:
            self._said_by_images = True
            self._warnings.append(Warned(frame.t_ns, BY_IMAGES, BY_IMAGES_WHY))
        self._motion = shutter_motion(self._rates, *self._way(frame.t_ns, attitude, motion))
        return replace(frame, grey=self._unrolling.image(frame.grey, self._motion))

    def _way(
        self, t_ns: int, attitude: CameraAttitude, motion: CameraMotion
    ) -> tuple[Array | None, Array | None]:
        """Velocity of the camera and the plane before it, as for `shutter_motion`."""
        pose, velocity = motion.carried_on(t_ns, attitude.at(t_ns)), motion.velocity
        if pose is None or velocity is None or self._last is None:
            return None, None
        return pose.rotation.T @ velocity.map_units_s, scene_plane(pose.inverse().apply(self._last))

    def of(self, track: Track) -> Track:
        """The track of this frame, with the motion by which its image was corrected.

        Its keypoints lie where the image that was read out shows them.
        """
        if self._motion is None or self._unrolling is None:
            return track
        keypoints = track.keypoints_px
        if keypoints is not None:
            keypoints = self._unrolling.seen(keypoints, self._motion)
        return replace(track, shutter_motion=self._motion, keypoints_px=keypoints)

    def end(self, view: View | None, slam_map: SlamMap) -> list[Warned]:
        """Compare what was seen in this frame, if it was tracked; warnings since the last call."""
        if slam_map is not self._map and self.watches:
            self._map = slam_map
            self._estimator.reset()
        self._last = None
        if view is not None and self._unrolling is not None:
            self._last = slam_map.positions[view.point_ids[view.point_ids >= 0]]
        if view is not None and self._rates is not None and self.watches:
            self._estimator.take(view, slam_map.positions, self._rates)
            self._judge(view.t_ns)
        said, self._warnings = self._warnings, []
        return said

    def _judge(self, t_ns: int) -> None:
        found = self._estimator.estimate
        if found is None:
            return
        if abs(found.readout_s) + SURE_SIGMAS * found.sigma_s < NOTICED_S:
            self._end_watch()
            return
        beyond = abs(found.readout_s) >= NOTICED_S
        if not beyond or found.sigma_s > MAX_SIGMA_RATIO * abs(found.readout_s):
            return
        self._end_watch()
        readout_ms, sigma_ms = self._readout_ms + 1e3 * found.readout_s, 1e3 * found.sigma_s
        if readout_ms < 0:
            detail = (
                f"its rows seem to be exposed from the bottom up, within {-readout_ms:.0f} ms: "
                "turn the image by 180 degrees, and the mount with it"
            )
        else:
            detail = f"its rows seem to be exposed over {readout_ms:.0f} +- {sigma_ms:.0f} ms"
        what = OTHER_READOUT if self._unrolling is not None else ROLLING
        self._warnings.append(Warned(t_ns, what, detail))

    def _end_watch(self) -> None:
        """Stop comparing frames, and let go of the map and the frames that were kept for it."""
        self.watches, self._map = False, None
        self._estimator.reset()


def scene_plane(points_camera: Array) -> Array | None:
    """Plane (3,) by points (N, 3): one over depth is its product with a ray (x, y, 1).

    By least squares with Huber's weights; None with too few points.
    """
    points = points_camera[points_camera[:, 2] > 0]
    if len(points) < MIN_POINTS:
        return None
    rays, inverse = points / points[:, 2:], 1.0 / points[:, 2]
    weight: Array = np.ones(len(points))
    plane: Array = np.zeros(3)
    for _ in range(ROUNDS):
        root = np.sqrt(weight)
        found = np.linalg.lstsq(rays * root[:, None], inverse * root, rcond=None)[0]
        plane = np.asarray(found, np.float64)
        off = np.abs(rays @ plane - inverse)
        scale = max(1.5 * float(np.median(off)), HUBER_RATIO * float(np.median(inverse)))
        weight = np.minimum(1.0, scale / np.maximum(off, 1e-12))
    return plane if np.isfinite(plane).all() else None
