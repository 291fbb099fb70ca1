"""How a map lies in the world: scale, heading, tilt and origin from the autopilot's positions.

A monocular map has neither unit nor north. Both come from comparing where the camera was in the map
with where the autopilot says it was (`trajectory_alignment`). Attitude gives the tilt, and heading
until the path does; without positions a rangefinder or the barometer gives the scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.config import GeoreferenceConfig
from companion.estimation.sample_series import SampleSeries
from companion.estimation.trajectory_alignment import (
    SIGMA_VELOCITY_M_S,
    SIGMA_YAW_RAD,
    VELOCITY_TAU_S,
    Scale,
    agreed,
    fit_map,
)
from companion.geometry.transforms import Array, Pose, Similarity
from companion.messages import (
    Georeference,
    HeightSample,
    PositionSample,
    PositionSource,
    RangeSample,
    Telemetry,
)

MIN_RANGES = 4
"""Fewer ranges have no median to speak of."""
MAX_HELD_NS = 400_000_000
"""A velocity may be as old as this."""
SIGMA_RANGE_SCALE, SIGMA_HEIGHT_SCALE = 0.01, 0.05
"""No rangefinder and no barometer tells the scale better than this."""
MAX_SIGMA_TURN_RAD = np.radians(8.0)
MAX_PLACES = 400
MAX_SIGMA_BEGUN = 0.5
"""A map that has just begun is placed by a scale no worse than this."""


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A keyframe to be placed: its pose in the map, and its attitude by the autopilot.

    `ground_units` is the distance from the body straight down its own axis to the map's ground, in
    map units, where the map shows it.
    """

    t_ns: int
    map_from_camera: Pose
    ned_from_camera: Array | None
    ground_units: float | None = None


class Georeferencer:
    """Collects what the autopilot says of its place; puts a map there when asked.

    With `sensors_only` the autopilot's own estimates are left aside: one that flies on our pose
    would give us our own errors back as truth.
    """

    def __init__(
        self,
        config: GeoreferenceConfig,
        body_from_camera: Pose | None,
        sensors_only: bool = False,
    ) -> None:
        self._config = config
        self._sources = [PositionSource.GPS] if sensors_only else list(PositionSource)
        self._body_from_camera = body_from_camera
        self._positions = {source: SampleSeries() for source in PositionSource}
        self._travel = {source: SampleSeries() for source in PositionSource}
        self._height = SampleSeries()
        self._range = SampleSeries()

    def take(self, sample: Telemetry) -> None:
        """Take a sample; those that say nothing of the place are ignored."""
        if isinstance(sample, PositionSample):
            self._positions[sample.source].add(sample.t_ns, sample.position_ned_m)
            if sample.velocity_ned_m_s is not None:
                self._integrate(self._travel[sample.source], sample.t_ns, sample.velocity_ned_m_s)
        elif isinstance(sample, HeightSample):
            self._height.add(sample.t_ns, np.array([-sample.height_m]))
        elif isinstance(sample, RangeSample):
            self._range.add(sample.t_ns, np.array([sample.distance_m]))

    def let_go(self, before_ns: int, keyframes_ns: Array) -> None:
        """Forget what was said before a time, save at the times of keyframes (N,), sorted."""
        for each in (*self._positions.values(), *self._travel.values(), self._height, self._range):
            each.let_go(before_ns, keyframes_ns)

    @property
    def has_ranges(self) -> bool:
        """Whether a rangefinder has told enough to compare with a map."""
        return len(self._range) >= MIN_RANGES

    def _integrate(self, series: SampleSeries, t_ns: int, velocity: Array) -> None:
        # rows: velocity, and the way travelled so far by it; a GPS may not tell the vertical part
        if series.newest is None:
            series.add(t_ns, np.stack([velocity, 0.0 * velocity]), horizontal_only=True)
            return
        before_ns, (previous, way) = series.newest
        dt = (t_ns - before_ns) * 1e-9
        travelled = way + 0.5 * (previous + velocity) * dt
        series.add(t_ns, np.stack([velocity, travelled]), horizontal_only=True)

    def way_between(self, from_ns: int, to_ns: int) -> Array | None:
        """How far the autopilot says the body went (3,), NED metres; None where it does not."""
        for source in self._sources:
            if len(self._positions[source]) >= 4:
                where, ok = self._positions[source].at(np.array([from_ns, to_ns]))
                if ok.all():
                    return np.asarray(where[1] - where[0], np.float64)
        return None

    def travelled(self, t_ns: Array) -> Array | None:
        """The way (N, 3) of the body so far by the autopilot's velocity at times (N,), NED metres.

        By one source; nan where it does not tell. None where none does.
        """
        for source in self._sources:
            series = self._travel[source]
            if len(series) >= 4:
                value, ok = series.at(t_ns)
                if np.count_nonzero(ok) > 1:
                    return np.where(ok[:, None], value[:, 1], np.nan)
        return None

    def lever_ned(self, ned_from_camera: Array) -> Array:
        """From body to camera (N, 3), NED metres, for rotations (N, 3, 3)."""
        if self._body_from_camera is None:
            return np.zeros((len(ned_from_camera), 3))
        mount = self._body_from_camera
        return np.asarray(ned_from_camera @ (mount.rotation.T @ mount.translation))

    def moved(self, from_ns: int, to_ns: int) -> Array | None:
        """The way (3,) by the autopilot's velocity, NED metres; None where it is not known.

        Beyond the newest sample the last velocity is held for a while.
        """
        for source in self._sources:
            series = self._travel[source]
            if len(series) < 2 or series.newest is None:
                continue
            newest_ns, _ = series.newest
            end_ns = min(to_ns, newest_ns)
            if to_ns - newest_ns > MAX_HELD_NS or from_ns > end_ns:
                continue
            (start, end), ok = series.at(np.array([from_ns, end_ns]))
            if ok.all():
                way = end[1] - start[1] + end[0] * ((to_ns - end_ns) * 1e-9)
                return np.asarray(np.nan_to_num(way), np.float64)
        return None

    def solve(self, places: list[Place]) -> Georeference | None:
        """Where the map lies; None until it is known well enough. Places may come in any order."""
        places = sorted(places, key=lambda place: place.t_ns)  # a joined map has its own after ours
        if len(places) > MAX_PLACES:
            chosen = np.unique(np.linspace(0, len(places) - 1, MAX_PLACES).astype(int))
            places = [places[int(i)] for i in chosen]
        level = _mean_rotation(places)
        for source in self._sources:
            if len(self._positions[source]) >= 4:
                found = self._from_positions(places, level, source)
                if found is not None:
                    return found
        if level is None:
            return None
        by_range, by_height = self._range_scale(places), self._height_scale(places, level)
        if by_range is None or by_height is None:
            return self._from_scale(places, level, by_range or by_height)
        return self._from_scale(places, level, agreed(by_range, by_height))

    def begin(self, places: list[Place], start_ned_m: Array) -> Georeference | None:
        """How a map lies that has just begun, its first keyframe at a known place (3,).

        Its scale is by the autopilot's velocity since, roughly; None where that does not tell.
        """
        first, last = places[0], places[-1]
        level, moved_m = _mean_rotation(places), self.moved(first.t_ns, last.t_ns)
        if level is None or moved_m is None:
            return None
        mapped = level @ (last.map_from_camera.translation - first.map_from_camera.translation)
        scale = float(mapped @ moved_m) / max(float(mapped @ mapped), 1e-12)
        way_s = (last.t_ns - first.t_ns) * 1e-9
        sigma_m = SIGMA_VELOCITY_M_S * float(np.sqrt(way_s * max(way_s, VELOCITY_TAU_S)))
        sigma = sigma_m / max(float(np.linalg.norm(moved_m)), 1e-9)
        if scale <= 0 or sigma > MAX_SIGMA_BEGUN:
            return None
        origin = start_ned_m - scale * level @ first.map_from_camera.translation
        return Georeference(
            Similarity(scale, level, origin), sigma, float(SIGMA_YAW_RAD), "velocity",
            len(places), 0.0,
        )  # fmt: skip

    def _from_positions(
        self, places: list[Place], level: Array | None, source: PositionSource
    ) -> Georeference | None:
        t_ns = np.array([p.t_ns for p in places])
        measured, ok = self._positions[source].at(t_ns)
        way = np.full((len(places), 3), np.nan)
        if len(self._travel[source]) >= 4:
            travelled, near = self._travel[source].at(t_ns)
            way[near] = travelled[near, 1]
        if ok.sum() < 4:
            return None
        kept = [p for p, good in zip(places, ok, strict=True) if good]
        mapped = np.stack([p.map_from_camera.translation for p in kept])
        target = measured[ok] + self._lever_ned(kept)
        extent = target - target.mean(0)
        if float(np.linalg.norm(extent, axis=1).max()) < 0.5 * self._config.min_travel_m:
            return None
        scales = [self._range_scale(places)]
        if level is not None:
            scales.append(self._height_scale(places, level))
        prior = min((s for s in scales if s is not None), key=lambda s: s.sigma, default=None)
        solution = fit_map(t_ns[ok] * 1e-9, mapped, target, way[ok], level, prior)
        if solution is None:
            return None
        similarity, covariance, residual = solution
        sigma_scale, sigma_yaw = float(np.sqrt(covariance[0, 0])), float(np.sqrt(covariance[3, 3]))
        if sigma_scale > self._config.max_sigma_scale:
            return None
        if level is None and float(np.diag(covariance)[1:4].max()) > float(MAX_SIGMA_TURN_RAD) ** 2:
            return None  # a straight path does not tell how the map lies about it
        with_velocity = np.isfinite(way[ok, :2]).all(1).sum() > 4
        method = " and ".join(
            [source.value, *(["velocity"] if with_velocity else []),
             *([prior.method] if prior is not None else [])]
        )  # fmt: skip
        return Georeference(similarity, sigma_scale, sigma_yaw, method, int(ok.sum()), residual)

    def _lever_ned(self, places: list[Place]) -> Array:
        """The same of places; nothing where their attitude is not known."""
        untold = np.zeros((3, 3))
        turns = [untold if p.ned_from_camera is None else p.ned_from_camera for p in places]
        return self.lever_ned(np.stack(turns))

    def _range_scale(self, places: list[Place]) -> Scale | None:
        """Scale from the rangefinder against the map's ground."""
        if not self.has_ranges:
            return None
        distance, ok = self._range.at(np.array([p.t_ns for p in places]))
        ratios = np.array([
            d[0] / p.ground_units
            for p, d, good in zip(places, distance, ok, strict=True)
            if good and p.ground_units is not None
        ])  # fmt: skip
        if len(ratios) < MIN_RANGES:
            return None
        scale = float(np.median(ratios))
        spread = 1.4826 * float(np.median(np.abs(ratios - scale))) / scale
        sigma = max(spread / np.sqrt(len(ratios)), SIGMA_RANGE_SCALE)
        return Scale(scale, sigma, "rangefinder", len(ratios))

    def _height_scale(self, places: list[Place], level: Array) -> Scale | None:
        """Scale from changes of barometric height."""
        if len(self._height) < 4:
            return None
        t_ns = np.array([p.t_ns for p in places])
        down, ok = self._height.at(t_ns)
        if ok.sum() < 4:
            return None
        mapped = np.stack([level @ p.map_from_camera.translation for p in places])[ok, 2]
        a, b = mapped - mapped.mean(), down[ok, 0] - down[ok, 0].mean()
        if float(np.ptp(b)) < self._config.min_travel_m:
            return None
        scale = float((a * b).sum() / max(float((a * a).sum()), 1e-12))
        if scale <= 0:
            return None
        size_m = float(np.sqrt(max(float((b * b).sum()), 1e-9)))
        sigma = max((0.5 + float(np.std(b - scale * a))) / size_m, SIGMA_HEIGHT_SCALE)
        return Scale(scale, sigma, "barometric height", int(ok.sum()))

    def _from_scale(
        self, places: list[Place], level: Array, found: Scale | None
    ) -> Georeference | None:
        """Scale alone: no positions, so no origin."""
        if found is None or found.sigma > self._config.max_sigma_scale:
            return None
        return self._without_origin(
            places, level, found.scale, found.sigma, found.method, found.n
        )  # fmt: skip

    def _without_origin(
        self, places: list[Place], level: Array, scale: float, sigma: float, method: str, n: int
    ) -> Georeference:
        start = places[0].map_from_camera.translation
        similarity = Similarity(scale, level, -scale * (level @ start))
        return Georeference(
            similarity, sigma, float(SIGMA_YAW_RAD), method, n, 0.0, has_origin=False
        )


def _mean_rotation(places: list[Place]) -> Array | None:
    """Rotation world_from_map by attitude alone: the chordal mean over keyframes; None without."""
    turns = [
        p.ned_from_camera @ p.map_from_camera.rotation.T
        for p in places
        if p.ned_from_camera is not None
    ]
    if not turns:
        return None
    u, _, vt = np.linalg.svd(np.sum(turns, axis=0))
    out: Array = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return out
