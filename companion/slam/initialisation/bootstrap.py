"""Search for a frame pair to initialise a map, with a buffer of the frames in between."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose
from companion.messages import Frame
from companion.slam.features.matching import match_descriptors
from companion.slam.features.orb_features import Features, Ints
from companion.slam.features.view import View
from companion.slam.initialisation.initializer import MIN_POINTS, initialise
from companion.slam.initialisation.third_view import middle_view, third_view_rejects

MAX_PENDING = 150
MIN_PARALLAX_DEG, MIN_PARALLAX_PX = 1.0, 8.0
"""Least parallax of the two views: the angle as in ORB-SLAM; in pixels too, as in low-resolution
images the same angle spans fewer, equally uncertain ones."""
FORWARD_IS_NORTH = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
"""Attitude `ned_from_camera` assumed where none is measured: level and looking north."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoViewReconstruction:
    """Two views with poses in a new map, and the points (N, 3) that both observe."""

    first: View
    second: View
    points_map: Array
    features_first: Ints
    features_second: Ints


class Bootstrap:
    """Tries each new frame against a reference frame until the pair initialises a map.

    `reference` fixes the first view, such as the last frame before tracking loss, while it
    overlaps. `min_parallax_ratio` scales the required parallax: more of it makes the motion
    estimate more certain.
    """

    def __init__(
        self, camera: Camera, reference: View | None = None, min_parallax_ratio: float = 1.0
    ) -> None:
        self._camera = camera
        self.pending: deque[View] = deque(maxlen=MAX_PENDING)
        self._reference = reference
        self._given = reference
        self._min_parallax_rad = min_parallax_ratio * max(
            np.radians(MIN_PARALLAX_DEG), MIN_PARALLAX_PX / camera.focal_px
        )

    def restart(self) -> None:
        """Take the next frame as the reference."""
        self._reference = self._given = None
        self.pending.clear()

    def step(
        self, frame: Frame, features: Features, ned_from_camera: Array | None
    ) -> TwoViewReconstruction | None:
        """Take a frame; a reconstruction once a map can be initialised with it."""
        seq = frame.seq
        view = View(
            seq, frame.t_ns, features, ned_from_camera, frame.grey, Pose.identity(),
            np.full(len(features), -1),
        )  # fmt: skip
        self.pending.append(view)
        reference = self._reference
        if reference is not None and reference is not self._given:
            reference = self._reference = self._with_attitude(reference)
        if reference is None:
            if len(features) >= 2 * MIN_POINTS:
                self._reference = view
            return None
        if reference is view:
            return None
        ia, ib = match_descriptors(reference.features, features)
        if len(ia) < MIN_POINTS:
            # overlap is lost: restart from a frame in between, else from this one
            between = [
                v
                for v in self.pending
                if reference.seq < v.seq < seq and len(v.features) >= 2 * MIN_POINTS
            ]
            self._reference = between[len(between) // 2] if between else None
            return None
        shift = np.linalg.norm(reference.features.pixels[ia] - features.pixels[ib], axis=1)
        if np.median(shift) < 3.0:
            return None
        attitudes = None
        if ned_from_camera is not None and reference.ned_from_camera is not None:
            attitudes = reference.ned_from_camera, ned_from_camera
        focal_px = self._camera.focal_px
        result = initialise(
            reference.features, features, ia, ib, focal_px, seq + 1, attitudes,
            self._min_parallax_rad,
        )  # fmt: skip
        third = middle_view(self.pending, reference, view)
        if result is None or third_view_rejects(third, reference, view, result):
            return None
        # the map: axes by the first view's attitude, unit length its median depth
        unit = 1.0 / float(np.median(result.points_a[:, 2]))
        map_rotation = (
            reference.ned_from_camera if reference.ned_from_camera is not None else FORWARD_IS_NORTH
        )
        reference.camera_from_map = Pose(map_rotation.T, np.zeros(3))
        b_from_a = Pose(result.b_from_a.rotation, result.b_from_a.translation * unit)
        view.camera_from_map = b_from_a @ reference.camera_from_map
        points_map = result.points_a * unit @ map_rotation.T
        return TwoViewReconstruction(
            reference, view, points_map, result.features_a, result.features_b
        )

    def _with_attitude(self, reference: View) -> View:
        """The first view with an attitude, where the reference came before telemetry.

        Without attitudes a planar scene has two motion solutions, and gravity is unknown.
        """
        if reference.ned_from_camera is not None:
            return reference
        measured = (
            v
            for v in self.pending
            if v.ned_from_camera is not None and len(v.features) >= 2 * MIN_POINTS
        )
        return next(measured, reference)
