"""Rendered flights: images and telemetry of a camera on a known path over known ground."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from companion.config import Config
from companion.estimation.localisation import LocalisationStage
from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose, quaternion_from_rotation, rotation_from_vector
from companion.messages import Bytes, Frame, KeyframeAdded, Odometry, Track, Warned
from companion.products.flight_result import FlightResult
from companion.products.trajectory_error import Path, PathErrors, path_errors
from companion.runtime.in_order import in_order_of_time
from companion.telemetry import (
    AttitudeSample,
    PositionSample,
    PositionSource,
    RangeSample,
    Telemetry,
)
from tests.support.flights.scene import texture

CAMERA_DOWN = Pose(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.zeros(3))
"""`body_from_camera` of a camera that looks straight down, the top of its picture forward."""
START_NS = 1_700_000_000_000_000_000
ATTITUDE_HZ, POSITION_HZ = 50.0, 10.0
SKEW = rotation_from_vector(np.radians([0.3, -0.4, 0.5]))
"""By how much the autopilot's attitude is off."""
METRES_PER_TEXEL = 0.05

PathOf = Callable[[float], Pose]
"""`ned_from_body` by seconds since the start."""


class Terrain:
    """Flat ground, and flat roofs over it unless it is to be `plane`; z is down."""

    def __init__(self, seed: int, plane: bool = False) -> None:
        rng = np.random.default_rng(seed)
        everywhere = (-np.inf, -np.inf, np.inf, np.inf)
        self._levels = [(0.0, everywhere, texture(rng))]
        for k in range(0 if plane else 40):
            north, east = rng.uniform(-30, 30, 2)
            size = rng.uniform(2, 6)
            height = -rng.uniform(0.5, 3.5)
            place = (north, east, north + size, east + size)
            self._levels.append((height, place, self._levels[k % 5][2] if k > 4 else texture(rng)))
        self._levels[1:] = sorted(self._levels[1:], key=lambda level: -level[0])
        self._rays: dict[int, Bytes] = {}

    def picture(self, camera: Camera, ned_from_camera: Pose) -> Bytes:
        """What the camera sees (H, W); mid grey where a pixel has no ray or meets nothing."""
        rays = self._rays_of(camera) @ ned_from_camera.rotation.T.astype(np.float32)
        north, east, down = np.moveaxis(rays, -1, 0)
        centre = ned_from_camera.translation.astype(np.float32)
        seen = np.full(north.shape, 128, np.uint8)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for height, (n0, e0, n1, e1), pattern in self._levels:
                away = np.float32(height - centre[2]) / down
                n, e = centre[0] + away * north, centre[1] + away * east
                hit = (away > 0.1) & (away < 1e3) & (n > n0) & (n < n1) & (e > e0) & (e < e1)
                if not hit.any():
                    continue
                size = len(pattern)
                column, row = (
                    np.where(hit, np.mod(v / METRES_PER_TEXEL, size), -1.0).astype(np.float32)
                    for v in (e, n)
                )
                drawn = cv2.remap(
                    pattern, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
                )
                seen[hit] = drawn[hit]
        return seen

    def _rays_of(self, camera: Camera) -> np.ndarray:
        if id(camera) not in self._rays:
            u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
            flat = camera.normalise(np.stack([u, v], -1).reshape(-1, 2))
            rays = np.c_[flat, np.ones(len(flat))].reshape(camera.height, camera.width, 3)
            self._rays[id(camera)] = rays.astype(np.float32)
        return self._rays[id(camera)]


@dataclass(slots=True, eq=False)
class Flown:
    """What came of a flight."""

    stage: LocalisationStage
    result: FlightResult = field(default_factory=FlightResult)
    frames_ns: list[int] = field(default_factory=list)
    tracks: list[Track] = field(default_factory=list)
    odometry: list[Odometry] = field(default_factory=list)
    keyframes_s: list[float] = field(default_factory=list)
    """When keyframes came, seconds since the start."""
    warnings: list[str] = field(default_factory=list)
    truth: Path | None = None

    @property
    def placed_share(self) -> float:
        return len(self.result.poses()) / len(self.frames_ns)

    def errors(self) -> PathErrors:
        """Of the path as it is known in the end."""
        return self._errors_of([(p.t_ns, p.world_from_camera) for p in self.result.poses()])

    def live_errors(self) -> PathErrors:
        """Of the poses as they were first given, in the map's frame."""
        return self._errors_of([
            (t.t_ns, t.map_from_camera)
            for t in self.tracks
            if t.map_from_camera is not None and not t.backfilled
        ])  # fmt: skip

    def _errors_of(self, poses: list[tuple[int, Pose]]) -> PathErrors:
        path = Path(
            np.array([t_ns for t_ns, _ in poses], np.float64),
            np.stack([p.translation for _, p in poses]), np.stack([p.rotation for _, p in poses]),
        )  # fmt: skip
        assert self.truth is not None
        found = path_errors(path, self.truth)
        assert found is not None
        return found


def fly(
    camera: Camera, ned_from_body: PathOf, terrain: Terrain, seconds: float, rate_hz: float,
    *, told: bool = True, dropout_s: tuple[float, float] = (0.0, 0.0),
) -> Flown:  # fmt: skip
    """Fly, in lockstep; without `told` there is no telemetry, and the mount is not known.

    From the first to the second time of `dropout_s` the picture is white.
    """
    if not told:
        camera = replace(camera, body_from_camera=None)
    flown = Flown(LocalisationStage(Config(), camera, lambda _: nullcontext()))
    n = round(seconds * rate_hz)
    poses = [(_ns(k / rate_hz), ned_from_body(k / rate_hz) @ CAMERA_DOWN) for k in range(n)]
    flown.truth = Path(
        np.array([t for t, _ in poses], np.float64), np.stack([p.translation for _, p in poses]),
        np.stack([p.rotation for _, p in poses]),
    )  # fmt: skip

    def pictures() -> Iterator[Frame]:
        for seq, (t_ns, pose) in enumerate(poses):
            dropped_out = _ns(dropout_s[0]) <= t_ns < _ns(dropout_s[1])
            grey = terrain.picture(camera, pose)
            grey = np.full_like(grey, 252) if dropped_out else grey
            yield Frame(seq, t_ns, grey, np.repeat(grey[..., None], 3, 2))

    samples = list(_telemetry(ned_from_body, seconds)) if told else []
    for message in in_order_of_time(samples, pictures()):
        flown.result.take(message)
        if isinstance(message, Frame):
            flown.frames_ns.append(message.t_ns)
        for out in flown.stage.step(message):
            _note(flown, out)
    for out in flown.stage.finish():
        _note(flown, out)
    return flown


def _note(flown: Flown, message: object) -> None:
    flown.result.take(message)  # type: ignore[arg-type]
    if isinstance(message, Track):
        flown.tracks.append(message)
    elif isinstance(message, Odometry):
        flown.odometry.append(message)
    elif isinstance(message, KeyframeAdded):
        flown.keyframes_s.append((message.t_ns - START_NS) * 1e-9)
    elif isinstance(message, Warned):
        flown.warnings.append(message.what)


def _ns(after_s: float) -> int:
    return START_NS + round(after_s * 1e9)


def _telemetry(ned_from_body: PathOf, seconds: float) -> Iterator[Telemetry]:
    """Attitude a little off, positions that wander by decimetres, velocity, and a rangefinder."""
    samples: list[Telemetry] = []
    rng = np.random.default_rng(5)
    for after_s in np.arange(-1.0, seconds + 0.5, 1.0 / ATTITUDE_HZ):
        rotation = ned_from_body(after_s).rotation @ SKEW
        samples.append(AttitudeSample(_ns(after_s), quaternion_from_rotation(rotation)))
    for after_s in np.arange(-1.0, seconds + 0.5, 1.0 / POSITION_HZ):
        here, later = ned_from_body(after_s), ned_from_body(after_s + 0.05)
        before = ned_from_body(after_s - 0.05)
        wander = 0.3 * np.sin(after_s / np.array([17.0, 23.0, 19.0])) + rng.normal(0, 0.03, 3)
        velocity = (later.translation - before.translation) / 0.1 + rng.normal(0, 0.05, 3)
        samples.append(
            PositionSample(_ns(after_s), PositionSource.LOCAL, here.translation + wander, velocity)
        )
        samples.append(RangeSample(_ns(after_s), float(-here.translation[2])))
    yield from sorted(samples, key=lambda s: s.t_ns)
