"""A flight with a stereo pair that looks down, over drawn ground, and its depths."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Pose, rotation_from_vector
from companion.messages import Bytes
from companion.telemetry import DepthSample
from drivers.images.stereo_pair import StereoPair
from tests.support.flights.rendered_flight import CAMERA_DOWN, START_NS, Terrain
from tests.support.flights.scene import leaves

FIRST = Camera(
    320, 240, 260.0, 258.0, 161.0, 118.0, Distortion.RADTAN, (-0.1, 0.02, 0.001, -0.0005, 0.0),
    body_from_camera=CAMERA_DOWN,
)  # fmt: skip
FIRST_FROM_SECOND = Pose(
    rotation_from_vector(np.array([0.01, -0.02, 0.015])), np.array([0.3, 0.01, -0.02])
)
"""Thirty centimetres apart, and squinting a little."""
SECOND = replace(
    FIRST, fx=255.0, fy=256.0, cx=158.0, cy=121.0,
    body_from_camera=CAMERA_DOWN @ FIRST_FROM_SECOND,
)  # fmt: skip
SIGMA_GREY = 2.0
"""Noise of the images, grey levels."""


def ned_from_body(after_s: float) -> Pose:
    """Still for a second at 7 m, then in swings of metres."""
    t = max(after_s - 1.0, 0.0)
    grown = 1.0 - np.exp(-0.5 * t * t)
    place = grown * np.array([2.5 * np.sin(1.0 * t), 2.0 * np.sin(0.8 * t), 0.7 * np.sin(1.2 * t)])
    turn = grown * 0.2 * np.sin(np.array([1.1, 1.4, 0.8]) * t)
    return Pose(rotation_from_vector(turn), place + [0.0, 0.0, -7.0])


def with_baseline(stretched: float) -> Camera:
    """The second camera, its place from the first stated so many times as far."""
    apart = Pose(FIRST_FROM_SECOND.rotation, stretched * FIRST_FROM_SECOND.translation)
    return replace(SECOND, body_from_camera=CAMERA_DOWN @ apart)


@functools.cache
def ground() -> Terrain:
    """The ground that it flies over: its leaves take seconds to draw."""
    return Terrain(5, pattern=leaves)


def pictures_of(
    camera: Camera, terrain: Terrain, seconds: float, rate_hz: float, seed: int
) -> Iterator[tuple[int, Pose, Bytes]]:
    """Times, poses and noisy grey images (H, W) of one camera of the pair."""
    rng = np.random.default_rng(seed)
    assert camera.body_from_camera is not None
    for k in range(round(seconds * rate_hz)):
        pose = ned_from_body(k / rate_hz) @ camera.body_from_camera
        grey = terrain.picture(camera, pose) + rng.normal(0.0, SIGMA_GREY, (240, 320))
        t_ns = START_NS + round(k / rate_hz * 1e9)
        yield t_ns, pose, np.clip(grey, 0, 255).astype(np.uint8)


def stereo_depths(stated: Camera, seconds: float, rate_hz: float) -> list[DepthSample]:
    """Depths of a flight, at this rate, with the second camera's place as `stated`."""
    pair, terrain = StereoPair(FIRST, stated), ground()
    both = (
        pictures_of(each, terrain, seconds, rate_hz, k) for k, each in enumerate((FIRST, SECOND))
    )
    out = []
    for (t_ns, _, first), (_, _, second) in zip(*both, strict=True):
        found = pair.depths(first, second)
        for (u, v), depth_m, sigma_m in zip(*found[:3], strict=True):
            out.append(DepthSample(t_ns, float(u), float(v), float(depth_m), float(sigma_m)))
    return out
