"""Optical flow as a sensor that looks down measures it: velocity over height, with its quality.

Corners are tracked from frame to frame by pyramidal Lucas-Kanade (Bouguet 2000) in a reduced image;
the autopilot's attitudes take the rotation out of their bearings. Level ground at height h below
the camera has its points at h d, where d is a bearing of unit depression in NED. After a
translation t such a point is seen at d' = (d - t/h) / (1 - t_z/h), so that

    t_xy/h - d'_xy t_z/h = d_xy - d'_xy

which is linear in t/h, for a camera that looks down as for an oblique one, and without any metric
scale. It is solved by least squares, whitened to pixels, with Cauchy weights.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.estimation.attitude.camera_attitude import CameraAttitude
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, rotation_from_vector, vector_from_rotation
from companion.messages import Bytes, Floats, Frame, OpticalFlow
from companion.telemetry import RangeSample, Telemetry

Bools = NDArray[np.bool_]

WIDTH = 320
"""Images are reduced to about this width: a pixel is then 4 to 5 mrad of a 75-degree lens."""
MAX_CORNERS, MIN_INLIERS = 70, 15
CORNER_QUALITY, CORNER_SPACING_PX = 0.02, 5.0
"""In the image of half that width, where corners are searched."""
MARGIN_RATIO = 0.06
"""Part of the image along its edges where no corner is taken: it would soon be out of sight."""
WINDOW_PX, N_LEVELS, ROUNDS = 13, 3, 4
CONVERGED = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.02)
MIN_EIGENVALUE = 1e-3
"""Least smaller eigenvalue of the gradients about a corner, as OpenCV normalises it; noise of two
grey values gives a tenth."""
MAX_FORWARD_BACKWARD_PX = 0.4
MIN_DEPRESSION = float(np.sin(np.radians(12.0)))
"""Sine of the least depression of a bearing: nearer to the horizon it is hardly of the ground."""
CAUCHY_PX = 0.15
"""Least scale of the weights."""
MAX_RESIDUAL_PX, MAX_RELIEF_RATIO = 0.7, 0.25
"""Residual beyond which a corner is not of the ground: of tracking, and by flow for its relief."""
MIN_INLIER_RATIO = 0.5
MIN_DT_S, MAX_DT_S = 0.002, 0.3
MAX_SIGMA_RAD_S = 0.15
"""Standard deviation at which the quality is 0."""
FULL_INLIERS, FULL_SPREAD = 40, 0.12
"""Inliers, and their least standard deviation in shares of the image's width, of full quality."""
REPEATED_TURN_PX = 0.5
"""Rotation that must show in a picture: if not one pixel has changed, the camera repeats itself."""

RANGE_AGE_NS = 300_000_000

NO_ATTITUDE = "no autopilot attitude"
FIRST, TOO_LONG = "first frame", "no frame before it in time"
REPEATED, FEATURELESS = "repeated picture", "too little to track"
NO_GROUND = "what is seen does not move as level ground"


class _NoFlowError(Exception):
    """There is no flow; its argument says why."""


@dataclass(frozen=True, slots=True)
class _Picture:
    t_ns: int
    small: Bytes


@dataclass(frozen=True, slots=True)
class _Pair:
    """Two successive images with their `ned_from_camera` (3, 3)."""

    before: Bytes
    now: Bytes
    rotation_before: Array
    rotation_now: Array


class GroundVelocity(NamedTuple):
    """Velocity (3,) of the camera over its height above level ground, NED, 1/s, at a time.

    With its covariance (3, 3), 1/s2.
    """

    t_ns: int
    velocity_hz: Array
    covariance_hz2: Array


class FlowMeter:
    """Flow from each frame to the next, of a camera whose mount on the body is known."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._scale = max(1.0, camera.width / WIDTH)
        self._size = round(camera.width / self._scale), round(camera.height / self._scale)
        self._focal_px = camera.focal_px / self._scale
        self._normalised = self._normalise_all()
        self._last: _Picture | None = None
        self._velocity = np.zeros(3)
        """Velocity over height of the last measurement, NED, 1/s: predicts where corners go."""
        self._range: RangeSample | None = None
        self.over_ground: GroundVelocity | None = None
        """Of the last frame; None where its flow was not measured."""

    def take(self, sample: Telemetry) -> None:
        """Take a sample that is believed."""
        if isinstance(sample, RangeSample):
            self._range = sample

    def step(self, frame: Frame, attitude: CameraAttitude) -> OpticalFlow:
        """Flow since the frame before, of quality 0 where there is none."""
        small = np.asarray(
            cv2.resize(frame.grey, self._size, interpolation=cv2.INTER_AREA), np.uint8
        )
        before, now = self._last, _Picture(frame.t_ns, small)
        self._last, self.over_ground = now, None
        dt_s = 0.0 if before is None else 1e-9 * (now.t_ns - before.t_ns)
        try:
            if before is None:
                raise _NoFlowError(FIRST)
            if not MIN_DT_S < dt_s < MAX_DT_S:
                raise _NoFlowError(TOO_LONG)
            return self._measured(frame.seq, before, now, attitude)
        except _NoFlowError as why:
            self._velocity = np.zeros(3)
            return OpticalFlow(frame.seq, frame.t_ns, dt_s, why_not=str(why))

    def _measured(
        self, seq: int, before: _Picture, now: _Picture, attitude: CameraAttitude
    ) -> OpticalFlow:
        dt_s = 1e-9 * (now.t_ns - before.t_ns)
        rotation_before, rotation_now = attitude.at(before.t_ns), attitude.at(now.t_ns)
        if rotation_before is None or rotation_now is None:
            raise _NoFlowError(NO_ATTITUDE)
        turn_camera = vector_from_rotation(rotation_before.T @ rotation_now)
        turned_px = self._focal_px * float(np.linalg.norm(turn_camera))
        if turned_px > REPEATED_TURN_PX and np.array_equal(before.small, now.small):
            raise _NoFlowError(REPEATED)
        pair = _Pair(before.small, now.small, rotation_before, rotation_now)
        here_px, there_px = self._tracked(pair, dt_s)
        moved, covariance, inliers = self._translation(here_px, there_px, pair)
        # height and axes of the middle of the interval
        self._velocity = moved / (1.0 - 0.5 * moved[2]) / dt_s
        body_from_camera, _ = attitude.correction
        ned_from_body = (
            rotation_before @ rotation_from_vector(0.5 * turn_camera) @ body_from_camera.T
        )
        velocity_body = ned_from_body.T @ self._velocity * max(float(ned_from_body[2, 2]), 0.0)
        sigma_rad_s = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])) / dt_s
        self.over_ground = GroundVelocity(
            (before.t_ns + now.t_ns) // 2, self._velocity.copy(), covariance / dt_s**2
        )
        return OpticalFlow(
            seq, now.t_ns, dt_s, np.array([-velocity_body[1], velocity_body[0]]),
            body_from_camera @ turn_camera, sigma_rad_s,
            self._quality(here_px[inliers], sigma_rad_s), self._distance_m(now.t_ns),
        )  # fmt: skip

    def _distance_m(self, t_ns: int) -> float | None:
        """Distance of the ground along the body's down axis; None where unknown."""
        known = self._range is not None and abs(t_ns - self._range.t_ns) < RANGE_AGE_NS
        return self._range.distance_m if known and self._range is not None else None

    def _tracked(self, pair: _Pair, dt_s: float) -> tuple[Floats, Floats]:
        """Pixels (N, 2) of corners in both reduced images."""
        half = np.asarray(cv2.pyrDown(pair.before), np.uint8)  # where corners are searched
        height, width = half.shape
        x, y = round(MARGIN_RATIO * width), round(MARGIN_RATIO * height)
        corners = cv2.goodFeaturesToTrack(
            half[y : height - y, x : width - x], MAX_CORNERS, CORNER_QUALITY, CORNER_SPACING_PX
        )
        if corners is None or len(corners) < MIN_INLIERS:
            raise _NoFlowError(FEATURELESS)
        here = np.asarray(2.0 * (corners.reshape(-1, 2) + [x, y]), np.float32)
        expected = self._expected(here, pair, dt_s)
        known = np.isfinite(expected).all(1)
        here, guess = here[known], expected[known].astype(np.float32)
        if len(here) < MIN_INLIERS:
            raise _NoFlowError(FEATURELESS)
        there, found = _lucas_kanade(pair.before, pair.now, here, guess, N_LEVELS)
        back, found_back = _lucas_kanade(pair.now, pair.before, there, here, 1)
        good = found & found_back
        good &= ((back - here) ** 2).sum(1) < MAX_FORWARD_BACKWARD_PX**2
        if np.count_nonzero(good) < MIN_INLIERS:
            raise _NoFlowError(FEATURELESS)
        return here[good], there[good]

    def _expected(self, here: Floats, pair: _Pair, dt_s: float) -> Array:
        """Pixels of corners in the next image by its attitude and the last velocity."""
        bearings = self._bearings(here) @ pair.rotation_before.T
        ground = bearings / bearings[:, 2:] - self._velocity * dt_s
        seen = np.where(_is_ground(bearings)[:, None], ground, bearings)
        pixels: Array = (self._camera.project(seen @ pair.rotation_now) + 0.5) / self._scale - 0.5
        return pixels

    def _translation(
        self, here_px: Floats, there_px: Floats, pair: _Pair
    ) -> tuple[Array, Array, Bools]:
        """Translation over height in NED with its covariance (3, 3), and the mask of inliers."""
        here = self._bearings(here_px) @ pair.rotation_before.T
        there = self._bearings(there_px) @ pair.rotation_now.T
        usable = _is_ground(here) & _is_ground(there)
        n = int(np.count_nonzero(usable))
        if n < MIN_INLIERS:
            raise _NoFlowError(NO_GROUND)
        depth = there[usable, 2:]
        d_next = there[usable, :2] / depth
        rows = np.zeros((n, 2, 4))
        rows[:, 0, 0] = rows[:, 1, 1] = 1.0
        rows[:, :, 2] = -d_next
        rows[:, :, 3] = here[usable, :2] / here[usable, 2:] - d_next
        # d' changes with its normalised coordinates by this over the depth: errors in pixels
        slope = pair.rotation_now[:2, :2] - d_next[:, :, None] * pair.rotation_now[2, :2]
        rows = np.linalg.inv(slope) @ rows * (depth[:, :, None] * self._focal_px)
        rows, due = rows[:, :, :3], rows[:, :, 3]
        moved: Array = np.zeros(3)
        off_px: Array = np.zeros(n)
        weight: Array = np.ones(n)
        for _ in range(ROUNDS):
            weighted = (rows * weight[:, None, None]).reshape(-1, 3)
            normal = weighted.T @ rows.reshape(-1, 3)
            moved = np.asarray(np.linalg.solve(normal, weighted.T @ due.ravel()), np.float64)
            off_px = np.sqrt(((due - rows @ moved) ** 2).sum(1))
            scale_px = max(CAUCHY_PX, float(np.partition(off_px, n // 2)[n // 2]))
            weight = 1.0 / (1.0 + (off_px / scale_px) ** 2)
        flow_px = np.sqrt((due**2).sum(1))
        fits = off_px < MAX_RESIDUAL_PX + MAX_RELIEF_RATIO * flow_px
        n = int(np.count_nonzero(fits))
        if n < max(MIN_INLIERS, MIN_INLIER_RATIO * len(here)):
            raise _NoFlowError(NO_GROUND)
        inside = rows[fits].reshape(-1, 3)
        variance_px = float(off_px[fits] @ off_px[fits]) / (2 * n - 3)
        covariance = variance_px * np.linalg.inv(inside.T @ inside)
        inliers = np.zeros(len(here), bool)
        inliers[np.flatnonzero(usable)[fits]] = True
        return moved, covariance, inliers

    def _bearings(self, small_px: Floats) -> Array:
        """Bearings (N, 3) in camera axes, of unit depth; nan where undefined."""
        x, y = (np.ascontiguousarray(each[:, None]) for each in small_px.T)
        out = np.ones((len(small_px), 3))
        out[:, :2] = cv2.remap(
            self._normalised, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )[:, 0]
        return out

    def _normalise_all(self) -> Floats:
        """Normalised coordinates (H, W, 2) of the reduced image's pixels; nan where undefined."""
        width, height = self._size
        u, v = np.meshgrid(np.arange(width), np.arange(height))
        pixels = (np.stack([u.ravel(), v.ravel()], 1) + 0.5) * self._scale - 0.5
        return self._camera.normalise(pixels).reshape(height, width, 2).astype(np.float32)

    def _quality(self, inliers_px: Floats, sigma_rad_s: float) -> int:
        """1 to 255 by number, spread and agreement of inliers; 0 where too uncertain."""
        spread = float(inliers_px.std(0).min()) / self._size[0]
        share = min(1.0, len(inliers_px) / FULL_INLIERS) * min(1.0, spread / FULL_SPREAD)
        return round(255 * share * max(0.0, 1.0 - sigma_rad_s / MAX_SIGMA_RAD_S))


def _is_ground(bearings_ned: Array) -> Bools:
    """Mask of bearings (N, 3) well below the horizon; nan is not."""
    sine = bearings_ned[:, 2] / np.linalg.norm(bearings_ned, axis=1)
    return np.asarray(sine > MIN_DEPRESSION)


def _lucas_kanade(
    grey: Bytes, next_grey: Bytes, here: Floats, expected: Floats, n_levels: int
) -> tuple[Floats, Bools]:
    """Pixels of corners in the next image, and the mask of those found."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        grey, next_grey, here, expected.copy(), winSize=(WINDOW_PX, WINDOW_PX),
        maxLevel=n_levels - 1, flags=cv2.OPTFLOW_USE_INITIAL_FLOW, criteria=CONVERGED,
        minEigThreshold=MIN_EIGENVALUE,
    )  # fmt: skip
    return np.asarray(there, np.float32), np.ravel(found) == 1
