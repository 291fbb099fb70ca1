"""Synthetic flight: a square over a coloured hill, with all values known."""

from __future__ import annotations

import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Array, Pose, Similarity, quaternion_from_euler
from companion.geometry.transforms import rotation_from_quaternion as rotation
from companion.messages import (
    ClockReport,
    DepthMap,
    Frame,
    Georeference,
    MapUpdate,
    Message,
    PixelState,
    PointChunk,
    Track,
    TrackState,
    Warned,
)
from companion.messages.run_facts import RunFacts
from companion.telemetry import PositionSample, PositionSource

START_NS = 1_700_000_000_123_456_789
STEP_NS = 50_000_000
N_FRAMES = 240
PER_KEYFRAME = 20
LOST = range(100, 112)
N_INITIALISING = 10
METRES_PER_UNIT = 4.0
SIZE = (48, 64)
"""height and width of images"""

WORLD_FROM_MAP = Similarity(
    METRES_PER_UNIT, rotation(quaternion_from_euler(0.05, -0.1, 2.0)), np.array([30.0, -20.0, -9.0])
)


def place_m(seq: int) -> Array:
    """Where the camera is at a frame, north east down: a square of 40 m by 25 m that climbs."""
    side, along = divmod(4 * seq / N_FRAMES, 1)
    corners = np.array([[0, 0], [40, 0], [40, 25], [0, 25], [0, 0.0]])
    side = min(int(side), 3)
    flat = corners[side] + along * (corners[side + 1] - corners[side])
    return np.array([flat[0], flat[1], -20.0 - 5 * seq / N_FRAMES])


def world_from_camera(seq: int) -> Pose:
    """The true pose at a frame: looking down, its right to the east, a little askew."""
    down = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    askew = rotation(quaternion_from_euler(0.1, -0.2, 0.3 + 0.001 * seq))
    return Pose(askew @ down, place_m(seq))


def map_from_camera(seq: int) -> Pose:
    """The true pose in the map."""
    return WORLD_FROM_MAP.inverse().apply_to_pose(world_from_camera(seq))


def time_ns(seq: int) -> int:
    return START_NS + seq * STEP_NS


def frame(seq: int) -> Frame:
    return Frame(seq, time_ns(seq), np.zeros(SIZE, np.uint8), np.zeros((*SIZE, 3), np.uint8))


def track(seq: int) -> Track:
    """What the tracker says: initialising first, lost for a while, else the truth."""
    if seq < N_INITIALISING or seq in LOST:
        lost = seq in LOST
        return Track(seq, time_ns(seq), TrackState.LOST if lost else TrackState.INITIALISING)
    keyframe_id = seq // PER_KEYFRAME
    relative = map_from_camera(keyframe_id * PER_KEYFRAME).inverse() @ map_from_camera(seq)
    return Track(
        seq, time_ns(seq), TrackState.TRACKING, map_from_camera(seq), keyframe_id, relative,
        n_inliers=150 + seq % 37, n_matches=250, keypoints_px=np.zeros((5, 2), np.float32),
    )  # fmt: skip


def georeference() -> Georeference:
    return Georeference(WORLD_FROM_MAP, 0.008, 0.02, "GPS positions", 118, 0.42)


def update(known: bool = True, without: tuple[int, ...] = ()) -> MapUpdate:
    poses = {
        k: map_from_camera(k * PER_KEYFRAME)
        for k in range(N_FRAMES // PER_KEYFRAME)
        if k not in without
    }
    sparse = np.zeros((0, 3))
    return MapUpdate(1, time_ns(N_FRAMES), poses, sparse, georeference() if known else None)


def ground_m(n: int, seed: int) -> tuple[Array, Array]:
    """Points (n, 3) of a hill, and their colours (n, 3), by place."""
    flat = np.random.default_rng(seed).uniform([-8, -8], [48, 33], (n, 2))
    height = 6 * np.exp(-((flat - [12, 18]) ** 2).sum(1) / 60)
    red = 90 + 80 * (np.sin(flat[:, 0] * 0.8) > 0)
    rgb = np.stack([red, 110 + 2 * flat[:, 1], 40 + 20 * height], 1)
    return np.column_stack([flat, -height]), rgb


def chunk(keyframe_id: int, n: int = 4000) -> PointChunk:
    """Points all over the hill as one keyframe would hold them."""
    points, rgb = ground_m(n, keyframe_id)
    camera_from_map = map_from_camera(keyframe_id * PER_KEYFRAME).inverse()
    confidence = np.random.default_rng(keyframe_id).uniform(0, 1, n)
    up_camera = camera_from_map.rotation @ WORLD_FROM_MAP.rotation.T @ [0, 0, -1]
    return PointChunk(
        keyframe_id, time_ns(keyframe_id * PER_KEYFRAME),
        camera_from_map.apply(WORLD_FROM_MAP.inverse().apply(points)).astype(np.float32),
        rgb.astype(np.uint8), confidence.astype(np.float32),
        np.tile(up_camera, (n, 1)).astype(np.float32),
        (0.02 * (1 - confidence) / METRES_PER_UNIT).astype(np.float32),
    )  # fmt: skip


def depth_map(keyframe_id: int) -> DepthMap:
    """A slope in map units, with a hole."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    depth = (4 + 0.02 * rows + 0.01 * columns).astype(np.float32)
    depth[10:20, 30:40] = 0
    state = np.full(SIZE, PixelState.CONVERGED.value, np.uint8)
    rgb = np.dstack([rows * 5, columns * 3, np.full(SIZE, keyframe_id * 10)]).astype(np.uint8)
    return DepthMap(
        keyframe_id, time_ns(keyframe_id * PER_KEYFRAME), (60.0, 60.0, 31.5, 23.5), depth,
        depth * np.float32(0.01), state, np.ones(SIZE, np.float32), rgb, 12,
        {"search": 20.0 + keyframe_id},
    )  # fmt: skip


def position(seq: int) -> PositionSample:
    """The autopilot's own, off by half a metre."""
    where = place_m(seq) + [0.5, -0.3, 0.2]
    return PositionSample(time_ns(seq), PositionSource.GPS, where)


def messages(known: bool = True) -> list[Message]:
    """The whole flight, in the order in which it would come."""
    out: list[Message] = []
    for seq in range(N_FRAMES):
        out += [position(seq), frame(seq), track(seq)]
        if seq % PER_KEYFRAME == 0:
            out += [depth_map(seq // PER_KEYFRAME), chunk(seq // PER_KEYFRAME)]
    out += [Warned(START_NS, "late telemetry", "by 0.3 s"), Warned(START_NS, "late telemetry")]
    return [*out, update(known)]


def facts(**changes: object) -> RunFacts:
    times = {"n": 240.0, "p50_ms": 8.1, "p95_ms": 19.5, "total_s": 2.2}
    values: dict[str, object] = {
        "stage_times": {"features": times, "tracking": {**times, "p50_ms": 3.0, "total_s": 0.8}},
        "wall_s": 10.0,
        "clock": ClockReport("TIMESYNC", -83.0213, 14.2, 0.8, 1),
        "origin": GeoOrigin(47.3977, 8.5456, 488.0),
        "device": "a <device>",
        "config": {"depth": {"enabled": True, "stride": 2}},
        "versions": {"companion": "0.1.0", "numpy": "2.0"},
        "command": "companion replay a&b --out c",
        "peak_memory_mb": 512.25,
        "camera": Camera(64, 48, 60.0, 60.0, 31.5, 23.5),
        "n_frames_total": N_FRAMES,
        "completed": True,
        "dropped": {"frames": 0},
        "rates_hz": {"attitude": 10.0},
    }
    return RunFacts(**{**values, **changes})  # type: ignore[arg-type]
