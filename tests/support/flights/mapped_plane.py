"""Input of the depth stage for a synthetic flight with true poses, without a tracker."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.rolling_shutter import shutter_motion
from companion.geometry.transforms import Array, Pose, rotation_from_vector
from companion.messages import Frame, KeyframeAdded, MapUpdate, Message, Track, TrackState
from tests.support.flights.rolling_scene import rolled
from tests.support.flights.scene import DOWN_LOOKING, PlaneWorld

KEYFRAME_EVERY = 4


def _turning(pose: Pose, rates_rad_s: Array, t_s: float) -> Pose:
    return Pose(pose.rotation @ rotation_from_vector(rates_rad_s * t_s), pose.translation)


def at(k: int) -> Pose:
    """Where the camera is at frame k: 12 m above the ground, 0.2 m further with each."""
    turn = rotation_from_vector(np.array([0.01 * np.sin(k), 0.15, 0.004 * k])) @ DOWN_LOOKING
    return Pose(turn, np.array([0.05 * k, 0.2 * k - 3, -12.0]))


def told(
    camera: Camera,
    n: int,
    scale_of: dict[int, float] | None = None,
    rates_of: Callable[[int], Array] | None = None,
) -> Iterator[tuple[int, Message]]:
    """Messages of n frames in order, each with the frame's number, which is its time in ns too.

    With a rolling shutter the camera turns by `rates_of` a frame (3,), rad/s, while it is read out.
    """
    world = PlaneWorld(np.random.default_rng(21))
    poses: dict[int, Pose] = {}
    for k in range(n):
        grey, depth = world.render(camera, at(k))
        if rates_of is not None:
            assert camera.readout_ms
            pose_at = partial(_turning, at(k), rates_of(k))
            grey = rolled(world, camera, pose_at, 1e-3 * camera.readout_ms)
        yield k, Frame(k, k, grey, np.repeat(grey[..., None], 3, 2))
        keyframe = k // KEYFRAME_EVERY
        if k % KEYFRAME_EVERY == 0:
            poses[keyframe] = at(k)
        relative = poses[keyframe].inverse() @ at(k)
        track = Track(k, k, TrackState.TRACKING, at(k), keyframe, relative)
        if rates_of is not None:
            track = replace(track, shutter_motion=shutter_motion(rates_of(k)))
        yield k, track
        if k % KEYFRAME_EVERY == 0:
            v, u = np.nonzero(depth)
            some = slice(None, None, 97)
            n2 = camera.normalise(np.stack([u[some], v[some]], 1))
            z = depth[v[some], u[some]]
            points = np.c_[n2 * z[:, None], z]
            seen = points[np.isfinite(points).all(1)]
            yield k, KeyframeAdded(keyframe, k, k, at(k), seen)
            yield k, MapUpdate(k, k, dict(poses), np.zeros((0, 3)), None, scale_of or {})
