"""Simulated camera: flies circles over a textured plain, with known poses.

The pose is a function of CLOCK_MONOTONIC alone, so that any process can compute it for comparison.
"""

from __future__ import annotations

import math
import time

import cv2
import numpy as np

from companion.config import CameraConfig
from companion.errors import SourceError
from companion.geometry.camera import Camera
from companion.geometry.transforms import (
    Array,
    Pose,
    quaternion_from_euler,
    rotation_from_quaternion,
)
from companion.messages import Bytes
from drivers.camera.camera_source import Picture
from drivers.images.calibration_file import assumed_camera

PERIOD_S = 40.0
RADIUS_M = 6.0
HEIGHT_M = 8.0
TEXTURE_PX = 2048
METRES_PER_TEXEL = 0.017
DEFAULT_HFOV_DEG = 75.0
BODY_FROM_CAMERA = Pose(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
"""Looks straight down; forward is up in the image."""


def pattern_optics(config: CameraConfig) -> Camera:
    """Camera model, exact; its field of view is `camera.assumed_hfov_deg`."""
    given = assumed_camera(config.width, config.height, config.assumed_hfov_deg or DEFAULT_HFOV_DEG)
    return Camera(
        given.width, given.height, given.fx, given.fy, given.cx, given.cy,
        body_from_camera=BODY_FROM_CAMERA,
    )  # fmt: skip


def world_from_body(monotonic_ns: int) -> Pose:
    """Pose of the body in local NED: a circle that rises and falls, with changing attitude."""
    turn = 2 * math.pi * (monotonic_ns * 1e-9 / PERIOD_S)
    place = np.array(
        [
            RADIUS_M * math.sin(turn),
            RADIUS_M * math.cos(turn),
            -HEIGHT_M - 0.6 * math.sin(3 * turn),
        ]
    )
    roll = math.radians(3.0) * math.sin(7 * turn)
    pitch = math.radians(3.0) * math.cos(5 * turn)
    return Pose(rotation_from_quaternion(quaternion_from_euler(roll, pitch, 0.6 * math.sin(turn))),
                place)  # fmt: skip


def world_from_camera(monotonic_ns: int) -> Pose:
    """Pose of the camera."""
    return world_from_body(monotonic_ns) @ BODY_FROM_CAMERA


class PatternCamera:
    """Images at `camera.rate_hz`; skips those that it has no time to draw."""

    live = True
    start_s = 5.0
    silent_s = 1.0

    def __init__(self, config: CameraConfig) -> None:
        self._optics = pattern_optics(config)
        self._step_ns = round(1e9 / config.rate_hz)
        self._scene: PatternScene | None = None
        self._next_ns: int | None = None
        self.name = "test pattern"
        self.n_dropped = 0
        self.remarks: list[str] = []

    def open(self) -> None:
        """Open; see `CameraSource`."""
        self._scene = self._scene or PatternScene()
        self._next_ns = time.monotonic_ns() + self._step_ns

    def read(self, timeout_s: float) -> Picture | None:
        """Next image, once it is due; see `CameraSource`."""
        if self._next_ns is None or self._scene is None:
            raise SourceError(f"{self.name}: not open")
        wait_ns = self._next_ns - time.monotonic_ns()
        time.sleep(max(0.0, min(wait_ns * 1e-9, timeout_s)))
        late_ns = time.monotonic_ns() - self._next_ns
        if late_ns < 0:
            return None
        n_late = late_ns // self._step_ns
        due_ns = self._next_ns + n_late * self._step_ns
        self.n_dropped += n_late
        self._next_ns = due_ns + self._step_ns
        grey, rgb = self._scene.picture(self._optics, world_from_camera(due_ns))
        return Picture(due_ns, grey, rgb)

    def close(self) -> None:
        """Close."""
        self._next_ns = None


class PatternScene:
    """Plain at height 0 with table tops above it, so that the scene is not planar."""

    def __init__(self) -> None:
        rng = np.random.default_rng(20260101)
        self._texture = _texture(rng)
        self._colours = _colours()
        middle = TEXTURE_PX / 2
        plain = np.array(
            [[0, METRES_PER_TEXEL, -middle * METRES_PER_TEXEL],
             [METRES_PER_TEXEL, 0, -middle * METRES_PER_TEXEL],
             [0, 0, 1]]
        )  # fmt: skip
        self._plain_from_texel: Array = plain
        self.tops = [
            (0.4 + 0.3 * k, rng.uniform(-10, 8, 2), rng.uniform(1.5, 3.0)) for k in range(9)
        ]
        """Height, corner (north, east) and side of each; the lowest first, which others hide."""

    def picture(self, camera: Camera, pose: Pose) -> tuple[Bytes, Bytes]:
        """Grey and RGB image of a camera without distortion that looks down on it."""
        size = camera.width, camera.height
        pixel_from_texel = _pixel_from_plane(camera, pose, 0.0) @ self._plain_from_texel
        grey = np.asarray(
            cv2.warpPerspective(
                self._texture, pixel_from_texel, size, flags=cv2.INTER_LINEAR,
                borderMode=cv2.BORDER_REFLECT,
            ),
            np.uint8,
        )  # fmt: skip
        for number, (height, corner, side) in enumerate(self.tops):
            self._draw_top(grey, _pixel_from_plane(camera, pose, -height), number, corner, side)
        rgb = cv2.LUT(np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB), np.uint8), self._colours)
        return grey, np.asarray(rgb, np.uint8)

    def _draw_top(
        self, grey: Bytes, pixel_from_plane: Array, number: int, corner: Array, side: float
    ) -> None:
        n_texels = int(side / METRES_PER_TEXEL)
        first = 200 * number
        texture = self._texture[first : first + n_texels, -first - n_texels : TEXTURE_PX - first]
        corners = corner + side * np.array([[0, 0], [0, 1], [1, 1], [1, 0]])
        seen = np.c_[corners, np.ones(4)] @ pixel_from_plane.T
        if (seen[:, 2] <= 0).any():
            return
        outline = seen[:, :2] / seen[:, 2:]
        x, y, width, height = cv2.boundingRect(outline.astype(np.float32))
        x0, y0 = max(x, 0), max(y, 0)
        x1, y1 = min(x + width, grey.shape[1]), min(y + height, grey.shape[0])
        if x1 <= x0 or y1 <= y0:
            return
        to_texel = np.array(
            [[0, METRES_PER_TEXEL, corner[0]], [METRES_PER_TEXEL, 0, corner[1]], [0, 0, 1]]
        )
        shift = np.array([[1.0, 0, -x0], [0, 1, -y0], [0, 0, 1]])
        size = x1 - x0, y1 - y0
        drawn = cv2.warpPerspective(
            texture, shift @ pixel_from_plane @ to_texel, size, flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        mask = np.zeros((size[1], size[0]), np.uint8)
        # in sixteenths of a pixel, so that edges move as smoothly as what they bound
        edges = np.round((outline - [x0, y0]) * 16).astype(np.int32)
        cv2.fillConvexPoly(mask, edges, 255, shift=4)
        cv2.copyTo(np.asarray(drawn, np.uint8), mask, grey[y0:y1, x0:x1])


def _pixel_from_plane(camera: Camera, pose: Pose, down_m: float) -> Array:
    """Homography from (north, east, 1) in a level plane to pixels."""
    r = pose.rotation.T
    offset = r @ (np.array([0.0, 0.0, down_m]) - pose.translation)
    out: Array = camera.matrix() @ np.column_stack([r[:, 0], r[:, 1], offset])
    return out


def _texture(rng: np.random.Generator) -> Bytes:
    out = np.zeros((TEXTURE_PX, TEXTURE_PX), np.float32)
    for octave in range(3, 11):  # detail at all scales, so that every height shows corners
        noise = rng.normal(size=(2**octave, 2**octave)).astype(np.float32)
        resized = cv2.resize(noise, (TEXTURE_PX, TEXTURE_PX), interpolation=cv2.INTER_CUBIC)
        out += np.asarray(resized, np.float32) / np.float32(octave**0.5)
    low, high = np.percentile(out, [0.5, 99.5])
    return np.asarray(np.clip((out - low) / (high - low), 0, 1) * 255, np.uint8)


def _colours() -> Bytes:
    """Lookup table (1, 256, 3) from grey to colours of about that brightness."""
    grey = np.arange(256.0)
    red = np.interp(grey, [0, 128, 255], [10, 130, 235])
    green = np.interp(grey, [0, 128, 255], [0, 132, 255])
    blue = np.interp(grey, [0, 128, 255], [0, 90, 225])
    return np.stack([red, green, blue], 1).astype(np.uint8)[None]
