"""How a map lies in the world: scale, heading, tilt and origin from the autopilot's positions.

A monocular map has neither unit nor north. Both come from comparing where the camera was in the map
with where the autopilot says it was. Position errors of a GPS wander slowly: they are modelled as
an Ornstein-Uhlenbeck process, so that a metre of drift over a minute does not pass for scale;
velocity, whose errors do not add up, is used beside it. Attitude gives the tilt, and heading until
the path does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from companion.config import GeoreferenceConfig
from companion.geometry import (
    Array,
    Pose,
    Similarity,
    rotation_from_vector,
    skew,
    vector_from_rotation,
)
from companion.messages import (
    Georeference,
    HeightSample,
    PositionSample,
    PositionSource,
    RangeSample,
    Telemetry,
)

Bools = NDArray[np.bool_]
MAX_GAP_NS = 1_500_000_000
SAME_TIME_NS = 1_000_000
"""A sample of a frame's own time, as photographs have one, needs no other beside it."""
MAX_HELD_NS = 400_000_000
"""A velocity may be as old as this."""
MIN_SPACING_NS = 45_000_000
DRIFT_TAU_S = 40.0
SIGMA_DRIFT_M = 1.0
SIGMA_WHITE_M = 0.15
SIGMA_VELOCITY_M_S = 0.15
VELOCITY_TAU_S = 1.0
SIGMA_TILT_RAD = np.radians(0.5)
SIGMA_YAW_RAD = np.radians(6.0)
SIGMA_RANGE_SCALE, SIGMA_HEIGHT_SCALE = 0.01, 0.05
"""No rangefinder and no barometer tells the scale better than this."""
DISAGREE = 3.0
"""Standard deviations by which two scales differ that cannot both be right."""
MAX_SIGMA_TURN_RAD = np.radians(8.0)
MAX_PLACES = 400


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


class _Series:
    """Samples over time, not closer together than needed."""

    def __init__(self) -> None:
        self._n = 0
        self._times: NDArray[np.int64] = np.zeros(256, np.int64)
        self._values: Array = np.zeros(0)

    @property
    def newest(self) -> tuple[int, Array] | None:
        """Time and value of the last sample."""
        last = self._n - 1
        return (int(self._times[last]), self._values[last]) if self._n else None

    def add(self, t_ns: int, value: Array, horizontal_only: bool = False) -> None:
        known = value[..., :2] if horizontal_only else value
        early = self._n > 0 and t_ns - self._times[self._n - 1] < MIN_SPACING_NS
        if early or not np.isfinite(known).all():
            return
        if not self._n:
            self._values = np.zeros((len(self._times), *value.shape))
        elif self._n == len(self._times):
            self._times = np.concatenate([self._times, np.zeros_like(self._times)])
            self._values = np.concatenate([self._values, np.zeros_like(self._values)])
        self._times[self._n], self._values[self._n] = t_ns, value
        self._n += 1

    def at(self, t_ns: Array) -> tuple[Array, Bools]:
        """Interpolated values, and where samples on both sides are near enough."""
        times, values = self._times[: self._n], self._values[: self._n]
        i = np.clip(np.searchsorted(times, t_ns), 1, len(times) - 1)
        span = times[i] - times[i - 1]
        f = ((t_ns - times[i - 1]) / np.maximum(span, 1)).reshape(-1, *([1] * (values.ndim - 1)))
        nearest = np.minimum(np.abs(t_ns - times[i - 1]), np.abs(times[i] - t_ns))
        told = (span < MAX_GAP_NS) | (nearest <= SAME_TIME_NS)
        inside = (t_ns >= times[0]) & (t_ns <= times[-1]) & told
        return values[i - 1] * (1 - f) + values[i] * f, inside

    def __len__(self) -> int:
        return self._n


class _Scale(NamedTuple):
    """Metres per map unit, its relative standard deviation, and what told it."""

    scale: float
    sigma: float
    method: str
    n: int


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
        self._positions = {source: _Series() for source in PositionSource}
        self._travel = {source: _Series() for source in PositionSource}
        self._height = _Series()
        self._range = _Series()

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

    def _integrate(self, series: _Series, t_ns: int, velocity: Array) -> None:
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
        """Where the map lies; None until it is known well enough."""
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
        return self._from_scale(places, level, _agreed(by_range, by_height))

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
        solution = _fit(t_ns[ok] * 1e-9, mapped, target, way[ok], level, prior)
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
        """From body to camera, in NED."""
        if self._body_from_camera is None:
            return np.zeros((len(places), 3))
        lever_camera = self._body_from_camera.rotation.T @ self._body_from_camera.translation
        return np.stack([
            p.ned_from_camera @ lever_camera if p.ned_from_camera is not None else np.zeros(3)
            for p in places
        ])  # fmt: skip

    def _range_scale(self, places: list[Place]) -> _Scale | None:
        """Scale from the rangefinder against the map's ground."""
        if len(self._range) < 4:
            return None
        distance, ok = self._range.at(np.array([p.t_ns for p in places]))
        ratios = np.array([
            d[0] / p.ground_units
            for p, d, good in zip(places, distance, ok, strict=True)
            if good and p.ground_units is not None
        ])  # fmt: skip
        if len(ratios) < 4:
            return None
        scale = float(np.median(ratios))
        spread = 1.4826 * float(np.median(np.abs(ratios - scale))) / scale
        sigma = max(spread / np.sqrt(len(ratios)), SIGMA_RANGE_SCALE)
        return _Scale(scale, sigma, "rangefinder", len(ratios))

    def _height_scale(self, places: list[Place], level: Array) -> _Scale | None:
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
        return _Scale(scale, sigma, "barometric height", int(ok.sum()))

    def _from_scale(
        self, places: list[Place], level: Array, found: _Scale | None
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


def _agreed(first: _Scale, second: _Scale) -> _Scale:
    """The better of two, no surer than they agree: a rangefinder may see what the map does not."""
    best = min(first, second, key=lambda scale: scale.sigma)
    apart = abs(float(np.log(first.scale / second.scale)))
    if apart < DISAGREE * float(np.hypot(first.sigma, second.sigma)):
        return best
    return best._replace(sigma=apart)


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


def _start(mapped: Array, target: Array, level: Array | None) -> Similarity:
    """Closed form (Umeyama 1991); about the vertical only where the level is known."""
    ma, mb = mapped.mean(0), target.mean(0)
    a, b = mapped - ma, target - mb
    if level is None:
        u, d, vt = np.linalg.svd(b.T @ a)
        sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
        rotation = u @ sign @ vt
        scale = float((d * np.diag(sign)).sum() / (a * a).sum())
    else:
        rotation = level
        a = a @ level.T
        scale = float(np.sqrt((b * b).sum() / max(float((a * a).sum()), 1e-18)))
    return Similarity(scale, rotation, mb - scale * rotation @ ma)


def _drift_root(t_s: Array) -> Array:
    """Cholesky factor of the covariance of slowly wandering positions, for one axis."""
    gap = np.abs(t_s[:, None] - t_s[None, :])
    covariance = SIGMA_DRIFT_M**2 * np.exp(-gap / DRIFT_TAU_S) + SIGMA_WHITE_M**2 * np.eye(len(gap))
    return np.asarray(np.linalg.cholesky(covariance), np.float64)


def _fit(
    t_s: Array,
    mapped: Array,
    target: Array,
    way: Array,
    level: Array | None,
    scale: _Scale | None,
) -> tuple[Similarity, Array, float] | None:
    """Generalised least squares over (log scale, turn (3), origin (3)); covariance (7, 7).

    `scale` is what others say of it.
    """
    guess = _start(mapped, target, level)
    if not np.isfinite(guess.scale) or guess.scale <= 0:
        return None
    prior = (
        np.array([1 / SIGMA_TILT_RAD, 1 / SIGMA_TILT_RAD, 1 / SIGMA_YAW_RAD])
        if level is not None
        else np.full(3, 1e-3)
    )
    keep = np.ones(len(t_s), bool)
    steps = np.isfinite(way[1:, :2] - way[:-1, :2]).all(1)
    dt = np.diff(t_s)
    information, chi2, n_rows, root = np.eye(7), 0.0, 1, np.eye(len(t_s))
    for iteration in range(12):
        turned = guess.scale * mapped @ guess.rotation.T
        residual = target - turned - guess.translation
        if iteration == 6:  # positions that no drift explains
            size = np.linalg.norm(residual - np.median(residual, axis=0), axis=1)
            keep = size < max(5.0 * float(np.median(size)), 3.0)
        # derivative of the prediction: scale, turn, origin
        jac = np.zeros((len(t_s), 3, 7))
        jac[:, :, 0] = turned
        jac[:, :, 1:4] = -skew(turned)
        jac[:, :, 4:] = np.eye(3)
        information = np.zeros((7, 7))
        gradient = np.zeros(7)
        chi2, n_rows = 0.0, 0
        if iteration in (0, 6):
            root = _drift_root(t_s[keep])
        for axis in range(3):
            j = solve_triangular(root, jac[keep, axis], lower=True)
            r = solve_triangular(root, residual[keep, axis], lower=True)
            information += j.T @ j
            gradient += j.T @ r
            chi2 += float(r @ r)
            n_rows += len(r)
        use = steps & (dt < 5.0) & keep[1:] & keep[:-1]
        if use.any():
            j = (jac[1:] - jac[:-1])[use]
            r = ((way[1:] - way[:-1]) - (turned[1:] - turned[:-1]))[use]
            told = np.isfinite(r)
            j, r = j * told[..., None], np.where(told, r, 0.0)
            sigma_m = SIGMA_VELOCITY_M_S * np.sqrt(dt[use] * np.maximum(dt[use], VELOCITY_TAU_S))
            weight = 1.0 / sigma_m
            length = np.linalg.norm(r, axis=1) * weight
            weight = weight * np.sqrt(np.minimum(1.0, 3.0 / np.maximum(length, 1e-9)))
            j, r = j * weight[:, None, None], r * weight[:, None]
            information += np.einsum("nij,nik->jk", j, j)
            gradient += np.einsum("nij,ni->j", j, r)
            chi2 += float((r * r).sum())
            n_rows += int(told.sum())
        if scale is not None:
            information[0, 0] += scale.sigma**-2
            gradient[0] += np.log(scale.scale / guess.scale) / scale.sigma**2
        if level is not None:
            turn = vector_from_rotation(guess.rotation @ level.T)
            information[1:4, 1:4] += np.diag(prior**2)
            gradient[1:4] -= prior**2 * turn
        else:
            information[1:4, 1:4] += np.diag(prior**2)
        try:
            delta = np.asarray(np.linalg.solve(information, gradient), np.float64)
        except np.linalg.LinAlgError:
            return None
        delta[:4] = np.clip(delta[:4], -0.5, 0.5)
        guess = Similarity(
            guess.scale * float(np.exp(delta[0])),
            rotation_from_vector(delta[1:4]) @ guess.rotation,
            guess.translation + delta[4:],
        )
    inflation = max(chi2 / max(n_rows - 7, 1), 1.0)
    covariance = np.asarray(np.linalg.inv(information) * inflation, np.float64)
    error = target - guess.apply(mapped)
    return guess, covariance, float(np.sqrt((error[keep] ** 2).sum(1).mean()))
