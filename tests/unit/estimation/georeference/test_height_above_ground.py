"""Scale by a rangefinder from ground mapped ahead, where the camera does not look down."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest

from companion.config import Config
from companion.estimation.georeference.height_above_ground import HeightAboveGround
from companion.estimation.localisation import LocalisationStage
from companion.geometry.camera import Camera
from companion.geometry.transforms import (
    Array,
    Pose,
    quaternion_from_rotation,
    rotation_from_vector,
)
from companion.messages import Frame, KeyframeAdded, MapUpdate
from companion.telemetry import AttitudeSample, RangeSample
from tests.support.flights.scene import PlaneWorld

DOWN = np.array([0.0, 0.0, 1.0])
HEIGHT_M = 8.0
FRAME_NS = 100_000_000
T0_NS = 10**12


def flat(rng: np.random.Generator, n: int = 12_000, half_m: float = 20.0) -> Array:
    points: Array = np.c_[rng.uniform(-half_m, half_m, (n, 2)), rng.normal(scale=0.05, size=n)]
    return points


@pytest.mark.parametrize("lean_deg", [0.0, 10.0, 25.0])
def test_flat_ground_along_a_tilted_beam(rng: np.random.Generator, lean_deg: float) -> None:
    beam = rotation_from_vector(np.radians([lean_deg, 0.0, 0.0])) @ DOWN
    found = HeightAboveGround(flat(rng), DOWN).distance(np.array([1.0, -2.0, -HEIGHT_M]), beam)
    assert found == pytest.approx(HEIGHT_M / np.cos(np.radians(lean_deg)), rel=0.015)


def test_slope(rng: np.random.Generator) -> None:
    points = flat(rng)
    points[:, 2] -= 0.3 * points[:, 0]
    found = HeightAboveGround(points, DOWN).distance(np.array([5.0, 0.0, -HEIGHT_M - 1.5]), DOWN)
    assert found == pytest.approx(HEIGHT_M, rel=0.02)


def test_wall_gives_none(rng: np.random.Generator) -> None:
    wall = np.c_[np.zeros(2000), rng.uniform(-5, 5, 2000), rng.uniform(-6, 0, 2000)]
    assert HeightAboveGround(wall, DOWN).distance(np.array([0.0, 0.0, -HEIGHT_M]), DOWN) is None


def test_roof_edge_gives_the_surface_on_the_axis_or_none(
    rng: np.random.Generator,
) -> None:
    roof = flat(rng, n=60_000)
    roof[roof[:, 0] > 0, 2] -= 4.0
    ground = HeightAboveGround(roof, DOWN)
    n_known = 0
    for x_m in np.arange(-2.05, 2.0, 0.1):
        found = ground.distance(np.array([x_m, 0.0, -HEIGHT_M]), DOWN)
        n_known += found is not None
        true_m = HEIGHT_M if x_m < 0 else HEIGHT_M - 4.0
        assert found is None or found == pytest.approx(true_m, rel=0.02)
    assert 30 <= n_known < 41


def test_unmapped_ground_gives_none(rng: np.random.Generator) -> None:
    points = flat(rng)
    assert HeightAboveGround(points, DOWN).distance(np.array([60.0, 0.0, -HEIGHT_M]), DOWN) is None
    assert HeightAboveGround(points, DOWN).distance(np.array([0.0, 0.0, 5.0]), DOWN) is None
    assert (
        HeightAboveGround(points[:0], DOWN).distance(np.array([0.0, 0.0, -HEIGHT_M]), DOWN) is None
    )


def scale_error(pitch_deg: float, n_frames: int = 60) -> float:
    """Metres by the map to true metres, less one, of a flight straight on over boxes.

    With attitude and a rangefinder, and neither position nor barometer.
    """
    pitch = np.radians(pitch_deg)
    body_from_camera = np.array(
        [[0, -np.sin(pitch), np.cos(pitch)], [1, 0, 0], [0, np.cos(pitch), np.sin(pitch)]]
    )
    camera = Camera(
        320, 240, 230.0, 230.0, 159.5, 119.5, body_from_camera=Pose(body_from_camera, np.zeros(3))
    )
    beam = Camera(1, 1, 1.0, 1.0, 0.0, 0.0)
    looks_down = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    rng = np.random.default_rng(5)
    world = PlaneWorld(np.random.default_rng(7))
    stage = LocalisationStage(Config(), camera, lambda _: nullcontext())
    centres: dict[int, Array] = {}
    keyframes: dict[int, int] = {}
    update: MapUpdate | None = None
    for k in range(n_frames):
        t_ns = T0_NS + k * FRAME_NS
        lean = rotation_from_vector(
            np.array([0.04 * np.sin(k / 5), 0.05 * np.cos(k / 7), 0.02 * np.sin(k / 9)])
        )
        centre = np.array([0.3 * k - 10.0, 0.2 * np.sin(k / 8), -HEIGHT_M - 0.3 * np.sin(k / 10)])
        centres[t_ns] = centre
        list(stage.step(AttitudeSample(t_ns, quaternion_from_rotation(lean))))
        _, depth = world.render(beam, Pose(lean @ looks_down, centre))
        distance_m = float(depth[0, 0]) * (1.0 + 0.01 * float(rng.normal()))
        list(stage.step(RangeSample(t_ns, distance_m)))
        grey, _ = world.render(camera, Pose(lean @ body_from_camera, centre))
        frame = Frame(k, t_ns, grey, np.repeat(grey[..., None], 3, 2))
        for message in stage.step(frame):
            update = message if isinstance(message, MapUpdate) else update
            if isinstance(message, KeyframeAdded):
                keyframes[message.keyframe_id] = message.t_ns
    for message in stage.finish():
        update = message if isinstance(message, MapUpdate) else update
    assert update is not None
    assert update.georeference is not None, "no scale"
    assert update.georeference.method == "rangefinder"
    first, last = min(update.map_from_camera), max(update.map_from_camera)
    poses = update.map_from_camera
    way = poses[last].translation - poses[first].translation
    true_m = centres[keyframes[last]] - centres[keyframes[first]]
    scale = update.georeference.world_from_map.scale
    return scale * float(np.linalg.norm(way) / np.linalg.norm(true_m)) - 1.0


@pytest.mark.parametrize("pitch_deg", [30.0, 45.0, 80.0])
def test_rangefinder_alone_gives_the_scale(pitch_deg: float) -> None:
    assert abs(scale_error(pitch_deg)) < 0.04
