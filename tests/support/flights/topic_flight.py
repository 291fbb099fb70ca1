"""Synthetic flight as topics: bundles, and their messages."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose, Similarity
from companion.messages import (
    Frame,
    Georeference,
    KeyframeAdded,
    MapUpdate,
    Message,
    Track,
    TrackState,
)
from companion.topics.gatherer import Gatherer
from companion.topics.keyframe_bundle import Bundle

CAMERA = Camera(128, 96, 110.0, 110.0, 63.5, 47.5)
STEP_NS = 100_000_000
START_NS = 1_700_000_000_000_000_000
DEPTH = 2.0
"""Of a wall before the camera, which moves along it."""
STEP = 0.04
PER_KEYFRAME = 6
METRES_PER_UNIT = 5.0


def wall() -> np.ndarray:
    """A picture of it, wide enough for the flight."""
    noise = np.random.default_rng(5).integers(0, 255, (96, 704, 3), dtype=np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 1.5), np.uint8)


def pose(seq: int) -> Pose:
    return Pose(np.eye(3), np.array([STEP * seq, 0.0, 0.0]))


def frame(seq: int, picture: np.ndarray) -> Frame:
    shift = CAMERA.fx * STEP * seq / DEPTH
    moved = np.array([[1.0, 0.0, -shift], [0.0, 1.0, 0.0]])
    rgb = cv2.warpAffine(picture, moved, (CAMERA.width, CAMERA.height), flags=cv2.INTER_LINEAR)
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    return Frame(
        seq, START_NS + seq * STEP_NS, np.asarray(grey, np.uint8), np.asarray(rgb, np.uint8)
    )


def points() -> np.ndarray:
    flat = np.random.default_rng(6).uniform(-0.8, 0.8, (60, 2))
    return np.column_stack([flat, np.full(60, DEPTH)])


def update(seq: int) -> MapUpdate:
    known = {k: pose(k * PER_KEYFRAME) for k in range(seq // PER_KEYFRAME + 1)}
    world = Similarity(METRES_PER_UNIT, np.eye(3), np.array([10.0, 20.0, -30.0]))
    found = Georeference(world, 0.01, 0.01, "GPS positions", 50, 0.3)
    return MapUpdate(seq, START_NS + seq * STEP_NS, known, np.zeros((0, 3)), found)


def messages(n_frames: int) -> Iterator[Message]:
    """In the order in which localisation gives them, frames before all else."""
    picture = wall()
    for seq in range(n_frames):
        t_ns = START_NS + seq * STEP_NS
        yield frame(seq, picture)
        keyframe = seq - seq % PER_KEYFRAME
        relative = pose(keyframe).inverse() @ pose(seq)
        yield Track(
            seq, t_ns, TrackState.TRACKING, pose(seq), keyframe // PER_KEYFRAME, relative, 100, 120
        )
        if seq == keyframe:
            yield KeyframeAdded(seq // PER_KEYFRAME, seq, t_ns, pose(seq), points())
            yield update(seq)


def bundles(n_frames: int, run: str = "run", budget_bytes_s: float = 0.0) -> list[Bundle]:
    """The same as bundles, the last included."""
    gatherer = Gatherer(run, budget_bytes_s, 90)
    out = []
    for message in messages(n_frames):
        if isinstance(message, (Frame, Track, KeyframeAdded, MapUpdate)):
            out.append(gatherer.take(message))
    return [*(bundle for bundle in out if bundle is not None), gatherer.last()]
