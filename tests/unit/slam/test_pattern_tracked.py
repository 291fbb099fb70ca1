"""Tracking of the camera test pattern."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np

from companion.config import CameraConfig, Config
from companion.messages import Frame, Track
from companion.slam.tracking.prior import Prior
from companion.slam.tracking.tracker import Tracker
from drivers.camera.pattern_camera import PatternScene, pattern_optics, world_from_camera
from tests.support.flights.scene import aligned_error

STEP_NS = 100_000_000
N_FRAMES = 40


def test_test_pattern_is_tracked_to_centimetres() -> None:
    optics, scene = pattern_optics(CameraConfig(width=320, height=240)), PatternScene()
    tracker = Tracker(Config(), optics, lambda _: nullcontext())
    places: dict[int, np.ndarray] = {}
    for seq in range(N_FRAMES):
        pose = world_from_camera(seq * STEP_NS)
        grey, rgb = scene.picture(optics, pose)
        for message in tracker.step(
            Frame(seq, seq * STEP_NS, grey, rgb), Prior(None, pose.rotation)
        ):
            if isinstance(message, Track) and message.map_from_camera is not None:
                places[message.seq] = message.map_from_camera.translation
    assert len(places) > 0.9 * N_FRAMES
    truth = np.array([world_from_camera(seq * STEP_NS).translation for seq in sorted(places)])
    error_m, _ = aligned_error(np.array([places[seq] for seq in sorted(places)]), truth)
    assert error_m < 0.1  # 8 m above the ground, where a pixel is 0.04 m
