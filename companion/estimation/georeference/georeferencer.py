"""Georeference of a map: scale, heading, tilt and origin from autopilot positions.

A monocular map has neither scale nor north. Both follow from comparing camera positions in the map
with measured ones (`trajectory_alignment`). Attitude gives the tilt, and heading until the path
does; without positions a rangefinder or barometer gives the scale.
"""

from __future__ import annotations

from dataclasses import replace
from functools import reduce

import numpy as np

from companion.config import GeoreferenceConfig
from companion.estimation.georeference.alignment_sample import AlignmentSample, mean_rotation
from companion.estimation.georeference.depth_verdict import DepthVerdict
from companion.estimation.georeference.height_scales import HeightScales
from companion.estimation.georeference.measured_path import MeasuredPath
from companion.estimation.georeference.trajectory_alignment import (
    DISAGREE,
    SIGMA_TILT_RAD,
    SIGMA_VELOCITY_M_S,
    SIGMA_YAW_RAD,
    VELOCITY_TAU_S,
    Level,
    Scale,
    fit_map,
    fused,
    reconciled,
)
from companion.geometry.transforms import (
    Array,
    Pose,
    Similarity,
    angle_between,
    rotation_from_vector,
)
from companion.messages import Georeference, Warned
from companion.telemetry import PositionSample, PositionSource, Telemetry

MAX_SIGMA_ROTATION_RAD = np.radians(8.0)
MAX_SAMPLES = 400
SIGMA_BEND_RAD = np.radians(0.1)
"""Of the level of one part of a map against another."""
LOOKS_NORTH = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""`ned_from_camera` of a camera that looks north, level."""
DOWN = np.array([0.0, 0.0, 1.0])
MAX_SIGMA_SCALE_NEW_MAP = 0.5
"""Largest relative scale error at which a new map is placed."""


class Georeferencer:
    """Collects position measurements; georeferences a map on request.

    With `sensors_only` the autopilot's own estimates are ignored: one that flies on our pose would
    return our own errors.
    """

    def __init__(
        self,
        config: GeoreferenceConfig,
        body_from_camera: Pose | None,
        sensors_only: bool = False,
    ) -> None:
        self._config = config
        self._body_from_camera = body_from_camera
        self._warnings: list[Warned] = []
        self.path = MeasuredPath(sensors_only, lambda warning: self._warnings.append(warning))
        self._depths = DepthVerdict()
        self._heights = HeightScales(config.min_travel_m, body_from_camera)

    def take(self, sample: Telemetry) -> None:
        """Add a sample; irrelevant ones are ignored."""
        if isinstance(sample, PositionSample):
            self.path.take(sample)
        else:
            self._heights.take(sample)

    def warnings(self) -> list[Warned]:
        """Changes of the verdicts on velocity and depths since the last call."""
        out, self._warnings = self._warnings, []
        return out

    def prune(self, before_ns: int, keyframes_ns: Array) -> None:
        """Drop samples before a time, except at the times of keyframes (N,), sorted."""
        self._heights.prune(before_ns, keyframes_ns)
        self.path.prune(before_ns, keyframes_ns)

    @property
    def has_ranges(self) -> bool:
        """True if there are enough ranges to compare with a map."""
        return self._heights.has_ranges

    def lever_ned(self, ned_from_camera: Array) -> Array:
        """Lever arm from body to camera (N, 3), NED metres, for rotations (N, 3, 3)."""
        if self._body_from_camera is None:
            return np.zeros((len(ned_from_camera), 3))
        mount = self._body_from_camera
        return np.asarray(ned_from_camera @ (mount.rotation.T @ mount.translation))

    def solve(
        self, samples: list[AlignmentSample], inertial: Scale | None = None,
        depths: Scale | None = None,
    ) -> Georeference | None:  # fmt: skip
        """Georeference of the map; None until certain enough. Samples may be unordered.

        `inertial` is the scale by accelerometers, `depths` that by measured depths, where there are
        any.
        """
        samples = sorted(
            samples, key=lambda sample: sample.t_ns
        )  # keyframes of a merged map come after ours
        if len(samples) > MAX_SAMPLES:
            chosen = np.unique(np.linspace(0, len(samples) - 1, MAX_SAMPLES).astype(int))
            samples = [samples[int(i)] for i in chosen]
        level = levelled(mean_rotation(samples), inertial)
        known = self._heights.of(samples, None if level is None else level.world_from_map)
        others = reduce(fused, [*known, *([] if inertial is None else [inertial])], None)
        prior = others if depths is None else reconciled(others, depths)
        placed = self._by_positions(samples, level, prior)
        if depths is not None:
            by_others = others if placed is None else scale_of(placed)
            self._warnings += self._depths.compare(samples[-1].t_ns, depths, by_others)
        if placed is not None:
            return placed
        if level is None:
            return None if depths is None else self._as_it_began(samples, depths)
        return self._from_scale(samples, level.world_from_map, prior)

    def solve_carried(self, samples: list[AlignmentSample], carried: Level) -> Georeference | None:
        """Georeference by positions of a map without attitude, its rotation `carried` to it.

        None where positions contradict that rotation.
        """
        if mean_rotation(samples) is not None:
            return None
        placed = self._by_positions(samples, carried, None)
        if placed is None or placed.sigma_yaw_rad > float(MAX_SIGMA_ROTATION_RAD):
            return None
        off_rad = angle_between(placed.world_from_map.rotation, carried.world_from_map)
        return placed if off_rad < DISAGREE * carried.sigma_yaw_rad else None

    def _as_it_began(self, samples: list[AlignmentSample], depths: Scale) -> Georeference | None:
        """Georeference of a map whose attitude nobody measures: level as its first image is."""
        mount = self._body_from_camera
        forward = LOOKS_NORTH if mount is None else mount.rotation
        level = forward @ samples[0].map_from_camera.rotation.T
        found = self._from_scale(samples, level, depths)
        return None if found is None else replace(found, sigma_yaw_rad=float(np.pi))

    def _by_positions(
        self, samples: list[AlignmentSample], level: Level | None, prior: Scale | None
    ) -> Georeference | None:
        """Georeference by the first source of positions that gives one."""
        for source in self.path.sources:
            if len(self.path.positions[source]) >= 4:
                found = self._from_positions(samples, level, source, prior)
                if found is not None:
                    return found
        return None

    def travelled(self, samples: list[AlignmentSample]) -> tuple[Array, float, str] | None:
        """Displacement (3,) by velocity from the first to the last sample, NED metres.

        With its standard deviation, and the name of the method; None where unknown.
        """
        first_ns, last_ns = samples[0].t_ns, samples[-1].t_ns
        displacement_m = self.path.displacement_by_velocity(first_ns, last_ns)
        if displacement_m is None:
            return None
        way_s = (last_ns - first_ns) * 1e-9
        sigma_m = SIGMA_VELOCITY_M_S * float(np.sqrt(way_s * max(way_s, VELOCITY_TAU_S)))
        return displacement_m, sigma_m, "velocity"

    def levers_of(
        self, samples: list[AlignmentSample], world_from_map: Array | None = None
    ) -> Array:
        """Lever arms (N, 3) from body to camera, NED metres, of samples of one map.

        Where an attitude is unknown by a rotation (3, 3) of the map, that of the other attitudes if
        none is given; zero where nothing tells it.
        """
        turn = mean_rotation(samples) if world_from_map is None else world_from_map
        by_map = np.zeros((3, 3)) if turn is None else turn
        return self.lever_ned(np.stack([
            by_map @ p.map_from_camera.rotation if p.ned_from_camera is None else p.ned_from_camera
            for p in samples
        ]))  # fmt: skip

    def _from_positions(
        self, samples: list[AlignmentSample], level: Level | None, source: PositionSource,
        prior: Scale | None,
    ) -> Georeference | None:  # fmt: skip
        t_ns = np.array([p.t_ns for p in samples])
        measured, ok = self.path.positions[source].at(t_ns)
        travelled_m = np.full((len(samples), 3), np.nan)
        series = self.path.integral_of(source)
        if series is not None and len(series) >= 4:
            integrated_velocity, near = series.at(t_ns)
            travelled_m[near] = integrated_velocity[near, 1]
        if ok.sum() < 4:
            return None
        kept = [p for p, good in zip(samples, ok, strict=True) if good]
        mapped = np.stack([p.map_from_camera.translation for p in kept])
        turn = None if level is None else level.world_from_map
        target = measured[ok] + self.levers_of(kept, turn)
        extent = target - target.mean(0)
        if float(np.linalg.norm(extent, axis=1).max()) < 0.5 * self._config.min_travel_m:
            return None
        t_s = t_ns[ok] * 1e-9
        solution = fit_map(t_s, mapped, target, travelled_m[ok], level, prior)
        if solution is not None and level is None:  # no attitude but the map's own
            target = measured[ok] + self.levers_of(kept, solution[0].rotation)
            solution = fit_map(t_s, mapped, target, travelled_m[ok], level, prior)
        if solution is None:
            return None
        similarity, covariance, residual = solution
        sigma_scale, sigma_yaw = float(np.sqrt(covariance[0, 0])), float(np.sqrt(covariance[3, 3]))
        if sigma_scale > self._config.max_sigma_scale:
            return None
        if (
            level is None
            and float(np.diag(covariance)[1:4].max()) > float(MAX_SIGMA_ROTATION_RAD) ** 2
        ):
            return None  # the roll about a straight path is unobservable
        with_velocity = np.isfinite(travelled_m[ok, :2]).all(1).sum() > 4
        method = " and ".join(
            [source.value, *(["velocity"] if with_velocity else []),
             *([prior.method] if prior is not None else [])]
        )  # fmt: skip
        return Georeference(similarity, sigma_scale, sigma_yaw, method, int(ok.sum()), residual)

    def _from_scale(
        self, samples: list[AlignmentSample], level: Array, found: Scale | None
    ) -> Georeference | None:
        """Georeference from scale alone, without origin."""
        if found is None or found.sigma > self._config.max_sigma_scale:
            return None
        return self._without_origin(
            samples, level, found.scale, found.sigma, found.method, found.n
        )  # fmt: skip

    def _without_origin(
        self,
        samples: list[AlignmentSample],
        level: Array,
        scale: float,
        sigma: float,
        method: str,
        n: int,
    ) -> Georeference:
        start = samples[0].map_from_camera.translation
        similarity = Similarity(scale, level, -scale * (level @ start))
        return Georeference(
            similarity, sigma, float(SIGMA_YAW_RAD), method, n, 0.0, has_origin=False
        )


def scale_of(placed: Georeference) -> Scale:
    """The scale of a georeference."""
    return Scale(placed.world_from_map.scale, placed.sigma_scale, placed.method, placed.n_positions)


def levelled(level: Array | None, inertial: Scale | None) -> Level | None:
    """Rotation (3, 3) from map to world by attitude, with the accelerometers' vertical.

    The autopilot's own is off by half a degree for minutes.
    """
    if level is None or inertial is None or inertial.down_map is None:
        return None if level is None else Level(level, float(SIGMA_TILT_RAD))
    sigma_rad = float(np.hypot(inertial.sigma_down_rad, SIGMA_BEND_RAD))
    share = 1.0 / (1.0 + (sigma_rad / float(SIGMA_TILT_RAD)) ** 2)
    down = share * (level @ inertial.down_map) + (1.0 - share) * DOWN
    turned = turned_to(down / np.linalg.norm(down), DOWN) @ level
    return Level(turned, min(sigma_rad, float(SIGMA_TILT_RAD)))


def turned_to(first: Array, second: Array) -> Array:
    """The smallest rotation (3, 3) that takes one unit vector (3,) to another near it."""
    axis = np.cross(first, second)
    sine = float(np.linalg.norm(axis))
    angle_rad = float(np.arctan2(sine, first @ second))
    return rotation_from_vector(axis * (angle_rad / max(sine, 1e-12)))


def place_new_map(
    samples: list[AlignmentSample], start_ned_m: Array, displacement_m: Array, sigma_m: float,
    method: str,
) -> Georeference | None:  # fmt: skip
    """Georeference of a new map whose first keyframe is at `start_ned_m` (3,).

    Its scale is roughly that of a displacement (3,) from the first to the last sample, NED metres,
    of its axes that are known (others are nan); None where that is too uncertain.
    """
    first, last, level = samples[0], samples[-1], mean_rotation(samples)
    if level is None:
        return None
    mapped = level @ (last.map_from_camera.translation - first.map_from_camera.translation)
    known = np.isfinite(displacement_m)
    mapped, displacement_m = mapped[known], displacement_m[known]
    scale = float(mapped @ displacement_m) / max(float(mapped @ mapped), 1e-12)
    sigma = sigma_m / max(float(np.linalg.norm(displacement_m)), 1e-9)
    if scale <= 0 or sigma > MAX_SIGMA_SCALE_NEW_MAP:
        return None
    origin = start_ned_m - scale * level @ first.map_from_camera.translation
    return Georeference(
        Similarity(scale, level, origin), sigma, float(SIGMA_YAW_RAD), method, len(samples), 0.0
    )


def begun_at(own: Georeference, first_map: Array, start_ned_m: Array) -> Georeference:
    """A georeference with the origin at which its first keyframe, at `first_map`, began."""
    to_world = own.world_from_map
    origin = start_ned_m - to_world.scale * to_world.rotation @ first_map
    return replace(own, world_from_map=replace(to_world, translation=origin))
