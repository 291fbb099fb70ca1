"""Rendered flights: images and telemetry of a camera on a known path over known ground."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from companion.app.replay.poses_sent import PosesSent
from companion.config import Config
from companion.config_file import load_config
from companion.estimation.localisation import LocalisationStage
from companion.estimation.site.site_use import SiteUse
from companion.geometry.camera import Camera
from companion.geometry.transforms import (
    Pose,
    nearest_rotation,
    quaternion_from_rotation,
    rotation_from_vector,
    vector_from_rotation,
)
from companion.messages import Bytes, Frame, KeyframeAdded, Odometry, Track, Warned
from companion.products.flight_result import FlightResult
from companion.runtime.in_order import in_order_of_time
from companion.slam.map.site_map import SiteMap
from companion.telemetry import (
    AttitudeSample,
    ImuSample,
    PositionSample,
    PositionSource,
    RangeSample,
    Telemetry,
)
from tests.bench.accuracy.path_errors import Path, PathErrors, path_errors
from tests.support.flights.noisy_telemetry import with_noise
from tests.support.flights.reach import Reach
from tests.support.flights.scene import leaves, texture

CAMERA_DOWN = Pose(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.zeros(3))
"""`body_from_camera` of a camera that looks straight down, the top of its picture forward."""
START_NS = 1_700_000_000_000_000_000
ATTITUDE_HZ, POSITION_HZ = 50.0, 10.0
SKEW = rotation_from_vector(np.radians([0.3, -0.4, 0.5]))
"""By how much the autopilot's attitude is off."""
METRES_PER_TEXEL = 0.05
IMU_S, IMU_STEP_S = 0.01, 1e-3
"""Interval of an IMU, and the step of the differences that it is drawn from."""
GRAVITY_NED = np.array([0.0, 0.0, 9.80665])
N_EXPOSED = 6
"""Pictures in one exposure."""

PathOf = Callable[[float], Pose]
"""`ned_from_body` by seconds since the start."""


def as_it_is(after_s: float, grey: Bytes) -> Bytes:
    """The picture (H, W) of a camera without a fault."""
    return grey


def white_between(start_s: float, stop_s: float) -> Callable[[float, Bytes], Bytes]:
    """A camera that sees nothing for some time."""
    return lambda after_s, grey: np.full_like(grey, 252) if start_s <= after_s < stop_s else grey


class Terrain:
    """Flat ground, and flat roofs over it unless it is to be `plane`; z is down.

    All of it is larger by `scale`, detail too.
    """

    def __init__(
        self, seed: int, plane: bool = False,
        pattern: Callable[[np.random.Generator], Bytes] = texture, scale: float = 1.0,
    ) -> None:  # fmt: skip
        self._metres_per_texel = METRES_PER_TEXEL * scale
        rng = np.random.default_rng(seed)
        everywhere = (-np.inf, -np.inf, np.inf, np.inf)
        self._levels = [(0.0, everywhere, pattern(rng))]
        for k in range(0 if plane else 40):
            north, east = scale * rng.uniform(-30, 30, 2)
            size = scale * rng.uniform(2, 6)
            height = -scale * rng.uniform(0.5, 3.5)
            place = (north, east, north + size, east + size)
            self._levels.append((height, place, self._levels[k % 5][2] if k > 4 else pattern(rng)))
        self._levels[1:] = sorted(self._levels[1:], key=lambda level: -level[0])
        self._rays: dict[Camera, np.ndarray] = {}

    def add_roof(self, height_m: float, at: tuple[float, float], size_m: float, look: int) -> None:
        """Put a square roof with its corner at (north, east) there; `look` is a seed."""
        place = (*at, at[0] + size_m, at[1] + size_m)
        corner = np.rint(np.array(at) / self._metres_per_texel).astype(int)
        pattern = np.roll(leaves(np.random.default_rng(look), 256), corner, (0, 1))
        self._levels.append((-height_m, place, pattern))
        self._levels[1:] = sorted(self._levels[1:], key=lambda level: -level[0])

    def picture(self, camera: Camera, ned_from_camera: Pose) -> Bytes:
        """What the camera sees (H, W); mid grey where a pixel has no ray or meets nothing."""
        turned = self._rays_of(camera) @ ned_from_camera.rotation.T.astype(np.float32)
        rays = np.ascontiguousarray(np.moveaxis(turned, -1, 0))
        centre = ned_from_camera.translation.astype(np.float32)
        whole = np.full(rays[0].shape, 128, np.uint8)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            reach = Reach(rays)
            for height, (n0, e0, n1, e1), pattern in self._levels:
                part = reach.part(centre, height, (n0, e0, n1, e1))
                if part is None:
                    continue
                north, east, down = rays[:, part[0], part[1]]
                away = np.float32(height - centre[2]) / down
                n, e = centre[0] + away * north, centre[1] + away * east
                hit = (away > 0.1) & (away < 1e3) & (n > n0) & (n < n1) & (e > e0) & (e < e1)
                rows, columns = np.flatnonzero(hit.any(1)), np.flatnonzero(hit.any(0))
                if not len(rows):
                    continue
                box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
                hit, seen, size = hit[box], whole[part][box], len(pattern)
                column, row = (
                    np.where(hit, np.mod(v[box] / self._metres_per_texel, size), -1.0).astype(
                        np.float32
                    )
                    for v in (e, n)
                )
                drawn = cv2.remap(
                    pattern, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
                )
                seen[hit] = drawn[hit]
        return whole

    def _rays_of(self, camera: Camera) -> np.ndarray:
        if camera not in self._rays:
            u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
            flat = camera.normalise(np.stack([u, v], -1).reshape(-1, 2))
            rays = np.c_[flat, np.ones(len(flat))].reshape(camera.height, camera.width, 3)
            self._rays[camera] = rays.astype(np.float32)
        return self._rays[camera]


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
    warned: list[tuple[int, str]] = field(default_factory=list)
    """Times and kinds of warnings."""
    sent: PosesSent = field(default_factory=lambda: PosesSent(Config()))
    truth: Path | None = None

    @property
    def warnings(self) -> list[str]:
        """Kinds of warnings, in order of time."""
        return [what for _, what in self.warned]

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
    *, told: bool = True, seen: Callable[[float, Bytes], Bytes] = as_it_is, exposure_s: float = 0.0,
    imu_seed: int | None = None, settings: Sequence[str] = (), site: SiteMap | None = None,
    ned_from_head: PathOf | None = None, beside: Sequence[Telemetry] = (),
) -> Flown:  # fmt: skip
    """Fly, in lockstep; without `told` there is no telemetry, and the mount is not known.

    With `site` it is flown in the map of an earlier flight.

    What comes of a picture is `seen`, by seconds since the start. Frames are stamped in the
    middle of an exposure, in which what moves blurs. With `imu_seed` there is a noisy IMU, too. A
    camera on a gimbal is carried by `ned_from_head`; what that says of itself comes `beside` the
    telemetry.
    """
    mount = camera.body_from_camera or CAMERA_DOWN
    carried = ned_from_head or ned_from_body
    if not told:
        camera = replace(camera, body_from_camera=None)
    config = load_config(None, list(settings))
    use = None if site is None else SiteUse(site, camera, None)
    stage = LocalisationStage(config, camera, lambda _: nullcontext(), site=use)
    flown = Flown(stage, sent=PosesSent(config))
    n = round(seconds * rate_hz)
    poses = [(_ns(k / rate_hz), carried(k / rate_hz) @ mount) for k in range(n)]
    within_s = exposure_s * (np.arange(N_EXPOSED) / N_EXPOSED - 0.5 + 0.5 / N_EXPOSED)

    def picture(k: int) -> Bytes:
        if not exposure_s:
            return terrain.picture(camera, poses[k][1])
        drawn = [
            terrain.picture(camera, carried(k / rate_hz + s) @ mount).astype(np.uint16)
            for s in within_s
        ]
        return np.asarray(sum(drawn) // N_EXPOSED, np.uint8)

    flown.truth = Path(
        np.array([t for t, _ in poses], np.float64), np.stack([p.translation for _, p in poses]),
        np.stack([p.rotation for _, p in poses]),
    )  # fmt: skip

    def pictures() -> Iterator[Frame]:
        for seq, (t_ns, _) in enumerate(poses):
            grey = seen(seq / rate_hz, picture(seq))
            yield Frame(seq, t_ns, grey, np.repeat(grey[..., None], 3, 2))

    samples = list(telemetry_of(ned_from_body, seconds)) if told else []
    if imu_seed is not None:
        still = inertial_samples(ned_from_body, seconds)
        samples = sorted([*samples, *with_noise(still, imu_seed)], key=lambda s: s.t_ns)
    samples = sorted([*samples, *beside], key=lambda s: s.t_ns) if beside else samples
    for message in in_order_of_time(samples, pictures()):
        flown.result.take(message)
        flown.sent.take(message)
        if isinstance(message, Frame):
            flown.frames_ns.append(message.t_ns)
        for out in flown.stage.step(message):
            _note(flown, out)
    for out in flown.stage.finish():
        _note(flown, out)
    return flown


def _note(flown: Flown, message: object) -> None:
    flown.result.take(message)  # type: ignore[arg-type]
    flown.sent.take(message)  # type: ignore[arg-type]
    if isinstance(message, Track):
        flown.tracks.append(message)
    elif isinstance(message, Odometry):
        flown.odometry.append(message)
    elif isinstance(message, KeyframeAdded):
        flown.keyframes_s.append((message.t_ns - START_NS) * 1e-9)
    elif isinstance(message, Warned):
        flown.warned.append((message.t_ns, message.what))


def leaning_path(
    place_m: Callable[[float], np.ndarray], yaw_rad: Callable[[float], float]
) -> PathOf:
    """A copter on a path (3,) in NED, which leans into where it accelerates."""

    def ned_from_body(after_s: float) -> Pose:
        step_s = 1e-3
        here = place_m(after_s)
        gained = place_m(after_s + step_s) + place_m(after_s - step_s) - 2.0 * here
        down = GRAVITY_NED - gained / step_s**2
        down /= np.linalg.norm(down)
        yaw = yaw_rad(after_s)
        right = np.cross(down, [np.cos(yaw), np.sin(yaw), 0.0])
        right /= np.linalg.norm(right)
        return Pose(nearest_rotation(np.stack([np.cross(right, down), right, down], 1)), here)

    return ned_from_body


def _ns(after_s: float) -> int:
    return START_NS + round(after_s * 1e9)


def telemetry_of(ned_from_body: PathOf, seconds: float) -> Iterator[Telemetry]:
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


def inertial_samples(ned_from_body: PathOf, seconds: float) -> Iterator[ImuSample]:
    """What an IMU without errors measures."""
    for after_s in np.arange(-1.0, seconds + 0.5, IMU_S):
        before, here, later = (ned_from_body(after_s + s) for s in (-IMU_STEP_S, 0.0, IMU_STEP_S))
        gained = later.translation + before.translation - 2.0 * here.translation
        turn = vector_from_rotation(before.rotation.T @ later.rotation)
        yield ImuSample(
            _ns(after_s), turn / (2.0 * IMU_STEP_S),
            here.rotation.T @ (gained / IMU_STEP_S**2 - GRAVITY_NED),
        )  # fmt: skip
