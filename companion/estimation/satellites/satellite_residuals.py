"""Positions of satellites less those of vision, and how they change over windows of time.

Vision knows how far the body went, not where it is: what is compared are displacements since the
beginning of a window, each with the standard deviation that both have together.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from companion.geometry.transforms import Array, Pose
from companion.messages import Georeference
from companion.telemetry import PositionSample

KEPT_S = 25.0
WINDOWS_S = (1.0, 1.6, 2.2, 3.0, 5.0, 10.0, 20.0)
"""The shorter, the sooner; the longer, the smaller a speed that is found."""
BASE_S, NOW_S = 1.0, 0.45
"""Means are taken over these at the beginning and at the end of a window."""
MAX_AHEAD_S = 0.35
"""Longest extrapolation of vision to the time of a position, and longest gap between two poses."""
SPEED_OVER_S = 0.5
WHITE_M = (0.25, 0.5)
"""Noise from one position to the next, horizontal and vertical, at least; more where they show
more."""
RATE_M_S = (0.1, 0.25)
"""By which the errors of a receiver wander: with satellites that come and go by 0.1 m/s in the
open; twice that, and vertically twice that again."""
OF_STATED, OF_STATED_HZ = 0.2, 0.08
"""The same as shares of the accuracy that a receiver states, where that gives more: one that is
worse wanders more."""
WRONG_VELOCITY = 0.2
"""Of a map, as a share of the way, by a velocity of the autopilot that nobody has judged yet: a
compass or a lens of optical flow that is off turns and stretches it by as much."""
PATH, PATH_NEAR_LIMITS = 0.01, 0.3
"""Drift of vision, as a share of the way: as a rule, and with few points in view. With 40 to 50 of
them, and every other picture dropped, `sample/survey` goes astray by 0.4 m in 1.4 m."""
LAG_S = 0.12
"""By which stamps of receivers and of an autopilot's link are off, before they have shown it:
counts where speed changes."""
LAG_WITHOUT_S, LAG_TAU_S, LAG_ERROR_M = 3.0, 5.0, 0.5
"""It is fitted to what is older than the first, so that no fault is taken for it; errors of
positions hold on for the second, and are of the third at least."""
SIGMA_SPEED_M_S = 0.2
N_STAND, STANDS_M, MOVES_M = 3, 0.03, 0.2
"""So many positions are the same, to a step of their last digit, while vision moves so far."""
JUMP_OVER_S = 0.7
"""A jump is against the mean of the positions before it within this."""
TILT_RAD = 0.02
"""Of the map against the vertical: a share of a level way that looks like height."""


class _Pair(NamedTuple):
    """A position of satellites, and the body in the map at its time."""

    t_s: float
    gps_m: Array
    gps_speed_m_s: Array
    place_map: Array
    speed_map: Array
    near_path_m: float
    """Vision's way near its limits up to then."""


class Change(NamedTuple):
    """Change of the residual over a window, m, with its standard deviations.

    `horizontal_m` (2,), `speed_m_s` (2,) of velocities alone, nan where there are none. `flown_m`
    (3,) is vision's displacement, `base_m` (3,) the residual at the beginning of the window;
    `gps_stands` is True where the last positions are all the same while vision moves.
    """

    window_s: float
    horizontal_m: Array
    sigma_horizontal_m: float
    vertical_m: float
    sigma_vertical_m: float
    speed_m_s: Array
    sigma_speed_m_s: float
    flown_m: Array
    base_m: Array
    gps_stands: bool


class SatelliteResiduals:
    """Pairs of the map that is tracked in; another map begins anew."""

    def __init__(self, camera_from_body: Pose) -> None:
        self._camera_from_body = camera_from_body
        self._poses: deque[tuple[float, Array, float]] = deque(maxlen=64)
        """Times, places in the map, and vision's way near its limits up to then."""
        self._pairs: deque[_Pair] = deque()
        self._map_id: int | None = None
        self._placed: Georeference | None = None
        self._stated_m = (0.0, 0.0)
        """Accuracy that the last position stated, horizontal and vertical."""
        self.placed_since_s: float | None = None
        """Time at which the map was first placed; None while it is not."""
        self.velocity_unproved = False
        """True where the map may be of a wrong velocity."""
        self.path_m = 0.0
        """Length of vision's way since the first pose, metres."""
        self._near_path_m = 0.0
        """The same, near its limits."""

    def take_pose(
        self, t_ns: int, map_id: int, map_from_camera: Pose, placed: Georeference | None,
        near_limits: bool = False,
    ) -> None:  # fmt: skip
        """Take the pose of a frame that was tracked, maybe near the limits of tracking."""
        if placed is None:
            self.clear()
            return
        if map_id != self._map_id:
            self.clear()
        self._map_id, self._placed = map_id, placed
        scale = placed.world_from_map.scale
        if self.placed_since_s is None:
            self.placed_since_s = 1e-9 * t_ns
        t_s, place = 1e-9 * t_ns, map_from_camera.apply(self._camera_from_body.translation / scale)
        if self._poses:
            step_m = scale * float(np.linalg.norm(place - self._poses[-1][1]))
            self.path_m += step_m
            self._near_path_m += step_m * near_limits
            if t_s - self._poses[-1][0] > MAX_AHEAD_S:
                self._poses.clear()
        self._poses.append((t_s, place, self._near_path_m))

    def clear(self) -> None:
        """Begin anew."""
        self._poses.clear()
        self._pairs.clear()
        self._map_id = self._placed = self.placed_since_s = None

    def take_position(self, sample: PositionSample) -> bool:
        """Pair a position with vision; False where vision is not known at its time."""
        at = self._vision_at(1e-9 * sample.t_ns)
        if at is None:
            return False
        speed = sample.velocity_ned_m_s
        self._stated_m = sample.sigma_horizontal_m or 0.0, sample.sigma_vertical_m or 0.0
        self._pairs.append(
            _Pair(
                1e-9 * sample.t_ns, sample.position_ned_m,
                np.full(2, np.nan) if speed is None else speed[:2], *at,
            )
        )  # fmt: skip
        while self._pairs[-1].t_s - self._pairs[0].t_s > KEPT_S:
            self._pairs.popleft()
        return True

    def drop_newest(self) -> None:
        """Forget the last pair."""
        self._pairs.pop()

    def keep_since(self, t_s: float) -> None:
        """Forget pairs before a time."""
        while self._pairs and self._pairs[0].t_s < t_s:
            self._pairs.popleft()

    def keep_until(self, t_s: float) -> None:
        """Forget pairs after a time."""
        while self._pairs and self._pairs[-1].t_s > t_s:
            self._pairs.pop()

    def offset_m(self, over_s: float) -> Array | None:
        """Mean residual (3,) over the last seconds; None without pairs."""
        if not self._pairs or self._placed is None:
            return None
        times, residual, *_ = self._arrays()
        mean: Array = residual[times >= times[-1] - over_s].mean(0)
        return mean

    def changes(self) -> list[Change]:
        """Change of the residual over each window that the pairs reach back to."""
        if len(self._pairs) < 4 or self._placed is None:
            return []
        times, residual, world, gps, speeds, own_speeds, near_paths_m = self._arrays()
        lag_s, sigma_lag_s = _lag_of(times, residual, own_speeds)
        residual = residual - lag_s * own_speeds
        white, rates = self._white(residual), self._rates
        now = times >= times[-1] - NOW_S
        n_now, now_s = int(np.count_nonzero(now)), times[now].mean()
        residual_now, world_now = residual[now].mean(0), world[now].mean(0)
        own_speed_now = own_speeds[now].mean(0)
        steps_m = np.linalg.norm(np.diff(world, axis=0), axis=1)
        stands = bool(
            np.ptp(gps[-N_STAND:, :2], axis=0).max() <= STANDS_M
            and np.ptp(world[-N_STAND:, :2], axis=0).max() > MOVES_M
        )
        out = []
        for window_s in WINDOWS_S:
            base = (times <= times[-1] - window_s) & (times >= times[-1] - window_s - BASE_S)
            n_base = int(np.count_nonzero(base))
            if not n_base:
                continue
            inside = times >= times[-1] - window_s
            residual_base = residual[base].mean(0)
            change = residual_now - residual_base
            flown = world_now - world[base].mean(0)
            span_s = float(now_s - times[base].mean())
            level_m = float(np.hypot(*flown[:2]))
            way_m = float(steps_m[inside[:-1]].sum())
            astray_m = PATH_NEAR_LIMITS * (near_paths_m[-1] - near_paths_m[base][0])
            faster = float(np.linalg.norm(own_speed_now - own_speeds[base].mean(0)))
            shared = np.sqrt(1.0 / n_base + 1.0 / n_now)
            placed = self._placed
            of_vision = np.array([
                PATH * way_m, placed.sigma_scale * level_m, placed.sigma_yaw_rad * level_m,
                sigma_lag_s * faster, WRONG_VELOCITY * level_m * self.velocity_unproved, astray_m,
            ])  # fmt: skip
            horizontal = np.linalg.norm([white[0] * shared, rates[0] * span_s, *of_vision])
            vertical = np.linalg.norm([
                white[1] * shared, rates[1] * span_s, PATH * way_m, TILT_RAD * way_m,
                placed.sigma_scale * abs(flown[2]), sigma_lag_s * faster, astray_m,
            ])  # fmt: skip
            speed = speeds[inside].mean(0) - own_speeds[inside].mean(0)[:2]
            sigma_speed = np.linalg.norm([SIGMA_SPEED_M_S, *(of_vision[1:] / span_s)])
            out.append(
                Change(
                    window_s, change[:2], float(horizontal), float(change[2]), float(vertical),
                    speed, float(sigma_speed), flown, residual_base, stands,
                )
            )  # fmt: skip
        return out

    def newest_jump(self) -> tuple[Array, float, float] | None:
        """Last residual against those just before: (3,) m, and what is expected of it.

        Standard deviations, horizontal and vertical. None without one before.
        """
        if len(self._pairs) < 3 or self._placed is None:
            return None
        times, residual, *_, own_speeds, near_paths_m = self._arrays()
        before = (times < times[-1]) & (times >= times[-1] - JUMP_OVER_S)
        if not before.any():
            return None
        white = self._white(residual[:-1])
        lag_m = LAG_S * float(np.linalg.norm(own_speeds[-1] - own_speeds[before].mean(0)))
        astray_m = PATH_NEAR_LIMITS * (near_paths_m[-1] - near_paths_m[before][0])
        moved: Array = residual[-1] - residual[before].mean(0)
        level_m, up_m = (float(np.linalg.norm([1.5 * w, lag_m, astray_m])) for w in white)
        return moved, level_m, up_m

    def _arrays(self) -> tuple[Array, Array, Array, Array, Array, Array, Array]:
        """Times, residuals, vision's places and positions of satellites; speeds of these.

        Last vision's way near its limits up to then.
        """
        assert self._placed is not None
        to_world = self._placed.world_from_map
        t_s, gps, speeds, places, own, near_paths_m = (
            np.array(each) for each in zip(*self._pairs, strict=True)
        )
        world, own_speeds = to_world.apply(places), to_world.scale * own @ to_world.rotation.T
        return t_s, gps - world, world, gps, speeds, own_speeds, near_paths_m

    @property
    def _rates(self) -> tuple[float, float]:
        """Wander of the errors, m/s, horizontal and vertical."""
        level, up = (OF_STATED_HZ * stated_m for stated_m in self._stated_m)
        return max(RATE_M_S[0], level), max(RATE_M_S[1], up)

    def _white(self, residual: Array) -> tuple[float, float]:
        """Noise of single positions, horizontal and vertical: stated, or shown in a row."""
        level, up = (OF_STATED * stated_m for stated_m in self._stated_m)
        steps = np.abs(np.diff(residual, axis=0))
        if len(steps) >= 8:
            # 1.48 medians are a standard deviation, which a difference has sqrt(2) times
            level = max(level, 1.05 * float(np.median(steps[:, :2])))
            up = max(up, 1.05 * float(np.median(steps[:, 2])))
        return max(WHITE_M[0], level), max(WHITE_M[1], up)

    def _vision_at(self, t_s: float) -> tuple[Array, Array, float] | None:
        """Place and speed of the body in the map, and the way near limits; None if not known."""
        if len(self._poses) < 2 or self._placed is None:
            return None
        times = [t for t, *_ in self._poses]
        if not times[0] <= t_s <= times[-1] + MAX_AHEAD_S:
            return None
        i = int(np.clip(np.searchsorted(times, t_s), 1, len(times) - 1))
        first = max(0, int(np.searchsorted(times, times[i] - SPEED_OVER_S)) - 1)
        first = min(first, i - 1)
        (t0, p0, _), (tb, pb, _) = self._poses[first], self._poses[i - 1]
        t1, p1, near_path_m = self._poses[i]
        speed = (p1 - p0) / (t1 - t0)
        if t_s <= t1:
            share = (t_s - tb) / (t1 - tb)
            return pb + share * (p1 - pb), speed, near_path_m
        return p1 + (t_s - t1) * speed, speed, near_path_m


def _lag_of(times: Array, residual: Array, own_speeds: Array) -> tuple[float, float]:
    """Time by which positions are ahead of their stamps, and its standard deviation, seconds.

    By the residual that goes with the speed: maximum a posteriori, with `LAG_S` before.
    """
    old = times < times[-1] - LAG_WITHOUT_S
    information = 1.0 / LAG_S**2
    if np.count_nonzero(old) < 2:
        return 0.0, LAG_S
    speed, error = (each[old, :2] - each[old, :2].mean(0) for each in (own_speeds, residual))
    spread = float((speed**2).sum())
    if spread == 0.0:
        return 0.0, LAG_S
    spacing_s = float(times[old][-1] - times[old][0]) / (np.count_nonzero(old) - 1)
    off_m = max(LAG_ERROR_M, float(np.sqrt((error**2).mean())))
    shown = spread / off_m**2 * min(1.0, spacing_s / LAG_TAU_S)
    lag_s = float((speed * error).sum()) / spread
    return lag_s * shown / (shown + information), float((shown + information) ** -0.5)
