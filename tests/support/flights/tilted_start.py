"""Maps initialised with a tilt: wrong motions and depths put into the initialiser's result.

| kind  | what is wrong                                                                          |
|-------|----------------------------------------------------------------------------------------|
| axes  | nothing but the axes: the whole map is tilted, as where the attitude was wrong then    |
| turn  | the second view is turned, and the points are where the rays then meet                 |
| depth | the ground is tilted about the first view, and the second is where that explains it    |
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np

from companion.geometry.transforms import Array, Pose, rotation_from_vector
from companion.slam.features.orb_features import Bools
from companion.slam.features.triangulation import triangulate
from companion.slam.initialisation import bootstrap
from companion.slam.initialisation.initializer import TwoViewGeometry, initialise
from companion.slam.optimisation.pose_refinement import refine_pose

KINDS = ("axes", "turn", "depth")
AXIS = np.array([0.8, 0.6, 0.0])
"""About which it is tilted, in the first camera's axes: as much sideways as to the front."""


@contextmanager
def tilted_starts(kind: str, tilt_deg: float, n: int = 1) -> Iterator[list[int]]:
    """Tilt the next `n` maps that begin; gives the frames with which they would, by number."""
    seen: list[int] = []
    turn = rotation_from_vector(np.radians(tilt_deg) * AXIS)
    step = bootstrap.Bootstrap.step

    def wrong(a: Any, b: Any, index_a: Any, index_b: Any, *rest: Any) -> TwoViewGeometry | None:
        found = initialise(a, b, index_a, index_b, *rest)
        if found is None or len(seen) >= n or kind == "axes":
            return found
        xa, xb = a.normalised[found.features_a], b.normalised[found.features_b]
        return (_turned if kind == "turn" else _deepened)(found, turn, xa, xb, b)

    def stepped(self: Any, frame: Any, *rest: Any) -> bootstrap.TwoViewReconstruction | None:
        found = step(self, frame, *rest)
        if found is None or len(seen) >= n:
            return found
        seen.append(frame.seq)
        if kind == "axes":
            for view in (found.first, found.second):
                pose = view.camera_from_map
                view.camera_from_map = Pose(pose.rotation @ turn.T, pose.translation)
            found = replace(found, points_map=found.points_map @ turn.T)
        return found

    with (
        patch.object(bootstrap, "initialise", wrong),
        patch.object(bootstrap.Bootstrap, "step", stepped),
    ):
        yield seen


def _turned(found: TwoViewGeometry, turn: Array, xa: Array, xb: Array, b: Any) -> TwoViewGeometry:
    pose = Pose(turn @ found.b_from_a.rotation, found.b_from_a.translation)
    points, _ = triangulate(xa, xb, pose)
    ahead = np.isfinite(points).all(1) & (points[:, 2] > 0) & (pose.apply(points)[:, 2] > 0)
    return _kept(found, pose, points, ahead) if ahead.sum() > 30 else found


def _deepened(found: TwoViewGeometry, turn: Array, xa: Array, xb: Array, b: Any) -> TwoViewGeometry:
    """The plane nearest to the points turned about where the first camera's axis meets it."""
    rays = np.c_[xa, np.ones(len(xa))]
    inverse_depth = 1.0 / found.points_a[:, 2]
    plane, *_ = np.linalg.lstsq(rays, inverse_depth, rcond=None)
    normal = turn @ plane
    normal *= plane[2] / normal[2]
    depth = 1.0 / (inverse_depth + rays @ (normal - plane))
    points = rays * depth[:, None]
    ahead = np.isfinite(depth) & (depth > 0)
    pose, _, _ = refine_pose(
        found.b_from_a, points[ahead], xb[ahead], b.whitening[found.features_b[ahead]], rounds=4
    )
    return _kept(found, pose, points, ahead)


def _kept(found: TwoViewGeometry, pose: Pose, points: Array, some: Bools) -> TwoViewGeometry:
    return replace(
        found, b_from_a=pose, points_a=points[some], features_a=found.features_a[some],
        features_b=found.features_b[some],
    )  # fmt: skip
