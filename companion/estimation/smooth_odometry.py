"""Where the body is, smoothly: the pose that an autopilot can fly on.

The map keeps learning: its scale, its heading and its place in the world are refined all the time,
and each refinement moves the pose of a camera that has not moved. Here the pose goes on from where
it was, and what was learned is worked in as slowly as an autopilot can follow.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose, yaw_rotation
from companion.messages import Georeference, Odometry, Track, TrackState

MAX_WORKED_IN_M_S = 0.15
MAX_WORKED_IN_RAD_S = np.radians(0.5)
MAX_ACCELERATION_M_S2 = 4.0
DOUBTED_NS, MIN_DOUBTED_FRAMES = 500_000_000, 3
"""Poses where motion cannot have brought the body are believed, as a reset, when they have agreed
with each other for so long: longer than any gap is bridged (feedback.max_gap_ms is 300 at most),
whatever the rate of the camera; and never by fewer frames."""
WAY_KEPT_NS = 10_000_000_000
SIGMA_COASTING_M_S = 0.3
"""Of the velocity by which a pose is carried on where nothing is recognised."""
FLOOR_M, FLOOR_RAD = 0.02, np.radians(0.3)
SIGMA_DRIFT = 0.005
"""Of the way: what a map that is not adjusted yet may be off by."""
SIGMAS_BEYOND_NOISE = 3.0
"""How much more matches of one image err together than each by itself says."""
FULL_COUNT = 150
GRID = 4


class _Waypoint(NamedTuple):
    """Where the body was, how far it had flown, and what had been worked into its pose by then."""

    t_ns: int
    place: Array
    flown_m: float
    worked_in: Array


class _Doubt(NamedTuple):
    """Poses where motion cannot have brought the body, since the last that was believed.

    The newest `n` of them, from `agreed_since_ns` to `t_ns`, agree with each other; the newest is
    at `place`.
    """

    since_ns: int
    agreed_since_ns: int
    t_ns: int
    place: Array
    n: int


class OdometryState(NamedTuple):
    """What another odometry needs to go on in the same frame: see `SmoothOdometry.take_up`."""

    odometry_from_world: Pose
    anchored: bool
    place_m: Array
    """(3,) of the body in the frame of odometry, when last seen,"""
    velocity_m_s: Array
    """and its velocity (3,)."""


class SmoothOdometry:
    """Tracks of the newest map and its georeference in, Odometry out; one for each frame."""

    def __init__(self, camera: Camera, max_jump_m: float) -> None:
        mount = camera.body_from_camera
        self._camera_from_body = mount.inverse() if mount is not None else Pose.identity()
        self._size = np.array([camera.width, camera.height], np.float64)
        self._max_jump_m = max_jump_m
        self._segment: int | None = None
        self._georeference: Georeference | None = None
        self._odometry_from_world = Pose.identity()
        self._last: tuple[int, Pose, Pose] | None = None
        """time, `map_from_camera`, `odometry_from_body` of the last frame that was believed"""
        self._anchored = False
        self._velocity = np.zeros(3)
        self._doubt: _Doubt | None = None
        self._coasting = False
        self._way: deque[_Waypoint] = deque()
        self._worked_in = np.zeros(3)
        self.reset_counter = 0

    def step(
        self,
        track: Track,
        segment: int,
        georeference: Georeference | None,
        velocity_map: tuple[Array, float] | None,
    ) -> Odometry:
        """Odometry of a frame.

        `segment` names the map that the track is in, `georeference` is that map's own, and
        `velocity_map` the camera's velocity in it with its standard deviation.
        """
        pose = track.map_from_camera
        known = track.state in (TrackState.TRACKING, TrackState.DEAD_RECKONING)
        if not known or pose is None or georeference is None:
            return self._unknown(track)
        if segment != self._segment or self._georeference is None:
            self._begin(segment, georeference, pose)
        elif georeference is not self._georeference:
            self._change(georeference)
        raw = self._raw(georeference, pose)
        if track.state is TrackState.DEAD_RECKONING:
            return self._coast(track, raw)
        if self._coasting:
            self._land(raw, track.t_ns)
        before = self._odometry_from_world, self._worked_in
        self._work_in(raw, track.t_ns)
        placed = self._odometry_from_world @ raw
        believable = self._believable(placed, track.t_ns)
        if not believable and not self._agreed(placed, track.t_ns):
            self._odometry_from_world, self._worked_in = before
            return self._unknown(track)
        doubted_ns = track.t_ns - self._doubt.since_ns if self._doubt is not None else 0
        if not believable or doubted_ns >= DOUBTED_NS:
            self.reset_counter += 1
            self._way.clear()
        self._doubt = None
        sigma_velocity = float("inf")
        if velocity_map is not None:
            to_world = georeference.world_from_map
            self._velocity = (
                self._odometry_from_world.rotation
                @ to_world.rotation
                @ velocity_map[0]
                * to_world.scale
            )
            sigma_velocity = velocity_map[1] * to_world.scale
        self._last = (track.t_ns, pose, placed)
        noise_m = SIGMAS_BEYOND_NOISE * track.sigma_position * georeference.world_from_map.scale
        way_sigma_m = self._way_sigma_m(track.t_ns, placed.translation, georeference.sigma_scale)
        return Odometry(
            track.seq, track.t_ns, track.state, self.reset_counter, self._quality(track), placed,
            self._velocity.copy(),
            float(np.linalg.norm([FLOOR_M, noise_m, way_sigma_m])),
            sigma_velocity,
            float(np.hypot(FLOOR_RAD, SIGMAS_BEYOND_NOISE * track.sigma_rotation_rad)),
            self._sigma_yaw_rad(georeference, SIGMAS_BEYOND_NOISE * track.sigma_rotation_rad),
        )  # fmt: skip

    def _sigma_yaw_rad(self, georeference: Georeference, noise_rad: float) -> float:
        """What the heading is off by from north.

        How well the map's is known, how far ours is known to be from the map's, by what was not
        worked in, and noise.
        """
        apart_rad = _yaw(self._odometry_from_world.rotation)
        return float(
            np.linalg.norm([FLOOR_RAD, noise_rad, georeference.sigma_yaw_rad, apart_rad])
        )

    def _way_sigma_m(self, t_ns: int, place: Array, sigma_scale: float) -> float:
        """What the way of the last seconds is off by, along each axis.

        Its scale, drift, and what was worked in, which moved the pose and not the body.
        """
        flown_m = 0.0
        if self._way:
            flown_m = self._way[-1].flown_m + float(np.linalg.norm(place - self._way[-1].place))
        self._way.append(_Waypoint(t_ns, place, flown_m, self._worked_in))
        while self._way[0].t_ns < t_ns - WAY_KEPT_NS:
            self._way.popleft()
        since = self._way[0]
        return float(np.linalg.norm([
            sigma_scale * float(np.linalg.norm(place - since.place)),
            SIGMA_DRIFT * (flown_m - since.flown_m),
            float(np.linalg.norm(self._worked_in - since.worked_in)) / np.sqrt(3.0),
        ]))  # fmt: skip

    def _coast(self, track: Track, raw: Pose) -> Odometry:
        """Carried on without seeing: of the lowest quality, and ever less certain."""
        assert track.map_from_camera is not None
        placed = self._odometry_from_world @ raw
        if self._last is not None:
            dt_s = max((track.t_ns - self._last[0]) * 1e-9, 1e-3)
            self._velocity = (placed.translation - self._last[2].translation) / dt_s
        self._coasting = True
        self._last = (track.t_ns, track.map_from_camera, placed)
        assert self._georeference is not None
        scale = self._georeference.world_from_map.scale
        return Odometry(
            track.seq, track.t_ns, track.state, self.reset_counter, 1, placed,
            self._velocity.copy(), max(FLOOR_M, scale * track.sigma_position),
            SIGMA_COASTING_M_S, float(np.hypot(FLOOR_RAD, track.sigma_rotation_rad)),
            self._sigma_yaw_rad(self._georeference, track.sigma_rotation_rad),
        )  # fmt: skip

    def _land(self, raw: Pose, t_ns: int) -> None:
        """See again: go on from where coasting led, as long as that is not far off."""
        self._coasting = False
        if self._last is None:
            return
        expected = self._last[2].translation + self._velocity * ((t_ns - self._last[0]) * 1e-9)
        off = expected - (self._odometry_from_world @ raw).translation
        if float(np.linalg.norm(off)) < self._max_jump_m:
            before = self._odometry_from_world
            self._odometry_from_world = Pose(before.rotation, before.translation + off)

    def _unknown(self, track: Track) -> Odometry:
        return Odometry(track.seq, track.t_ns, track.state, self.reset_counter)

    def _raw(self, georeference: Georeference, map_from_camera: Pose) -> Pose:
        """`world_from_body` as the map has it now."""
        return georeference.world_from_map.apply_to_pose(map_from_camera) @ self._camera_from_body

    def _begin(self, segment: int, georeference: Georeference, pose: Pose) -> None:
        """Another map than before, or the first: nothing ties its poses to those of the last."""
        offset = np.zeros(3)
        if self._last is not None:
            self.reset_counter += 1
            if not georeference.has_origin:  # go on from the place last known
                offset = self._last[2].translation - self._raw(georeference, pose).translation
        self._odometry_from_world = Pose(np.eye(3), offset)
        self._anchored = georeference.has_origin
        self._segment, self._georeference = segment, georeference
        self._last = None
        self._doubt = None
        self._coasting = False
        self._way.clear()

    def _change(self, georeference: Georeference) -> None:
        """The same map, better placed: the last pose stays where it was."""
        if self._last is not None:
            _, pose, placed = self._last
            raw = self._raw(georeference, pose)
            turn = yaw_rotation(_yaw(placed.rotation @ raw.rotation.T))
            self._odometry_from_world = Pose(turn, placed.translation - turn @ raw.translation)
        self._georeference = georeference

    @property
    def kept(self) -> OdometryState | None:
        """What it takes to go on from here; None before there was a pose."""
        if self._last is None:
            return None
        return OdometryState(
            self._odometry_from_world, self._anchored, self._last[2].translation.copy(),
            self._velocity.copy(),
        )  # fmt: skip

    def take_up(self, segment: int, georeference: Georeference, kept: OdometryState) -> None:
        """Go on in a frame from before; `segment` and `georeference` are of the map kept with it.

        The next pose is taken as it is: nothing tells how the body moved meanwhile.
        """
        self._segment, self._georeference = segment, georeference
        self._odometry_from_world, self._anchored = kept.odometry_from_world, kept.anchored
        self._last, self._doubt, self._coasting = None, None, False
        self._way.clear()

    def map_moved(self, map_from_camera: Pose) -> None:
        """The map was corrected: where in it the last believed frame is now.

        What was given stays where it was; the rest is worked in as slowly as anything learned.
        """
        if self._last is None or self._georeference is None:
            return
        t_ns, _, placed = self._last
        self._last = (t_ns, map_from_camera, placed)
        self._change(self._georeference)

    def _work_in(self, raw: Pose, t_ns: int) -> None:
        """Move towards the pose that the map has, where it began with a place in the world.

        A map that began without one goes on as it began: the way to a place found out later may be
        long, and an autopilot would fly it.
        """
        if self._last is None or not self._anchored:
            return
        dt_s = min((t_ns - self._last[0]) * 1e-9, 1.0)
        here = self._odometry_from_world @ raw
        yaw = _yaw(self._odometry_from_world.rotation)
        most = float(MAX_WORKED_IN_RAD_S) * dt_s
        turn = yaw_rotation(yaw - float(np.clip(yaw, -most, most)))
        away = here.translation - raw.translation
        far = float(np.linalg.norm(away))
        kept = max(far - MAX_WORKED_IN_M_S * dt_s, 0.0) / max(far, 1e-12)
        at = raw.translation + kept * away
        self._worked_in = self._worked_in + at - here.translation
        self._odometry_from_world = Pose(turn, at - turn @ raw.translation)

    def _believable(self, placed: Pose, t_ns: int) -> bool:
        """Whether motion can have brought the body here."""
        if self._last is None:
            return True
        return self._reached(self._last[2].translation, placed.translation, t_ns - self._last[0])

    def _agreed(self, placed: Pose, t_ns: int) -> bool:
        """Take a pose where motion cannot have brought the body; whether enough others agree."""
        place, doubt = placed.translation, self._doubt
        if doubt is None or not self._reached(doubt.place, place, t_ns - doubt.t_ns):
            self._doubt = _Doubt(doubt.since_ns if doubt else t_ns, t_ns, t_ns, place, 1)
            return False
        self._doubt = doubt = doubt._replace(t_ns=t_ns, place=place, n=doubt.n + 1)
        return t_ns - doubt.agreed_since_ns >= DOUBTED_NS and doubt.n >= MIN_DOUBTED_FRAMES

    def _reached(self, before: Array, after: Array, dt_ns: int) -> bool:
        """Whether motion can have brought the body from one place (3,) to another in a time."""
        dt_s = dt_ns * 1e-9
        expected = before + self._velocity * min(dt_s, 1.0)
        away_m = float(np.linalg.norm(after - expected))
        speed = float(np.linalg.norm(self._velocity))
        beyond_s = max(dt_s - 1.0, 0.0)
        return away_m < self._max_jump_m + 0.5 * MAX_ACCELERATION_M_S2 * dt_s**2 + speed * beyond_s

    def _quality(self, track: Track) -> int:
        """1..100: how many map points were found, over how much of the image, by how many tries."""
        if track.keypoints_px is None or not len(track.keypoints_px):
            return 1
        cells = np.clip((track.keypoints_px / self._size * GRID).astype(int), 0, GRID - 1)
        spread = len(np.unique(cells @ [1, GRID])) / GRID**2
        count = min(1.0, track.n_inliers / FULL_COUNT)
        found = track.n_inliers / max(track.n_matches, 1)
        return int(np.clip(round(100 * count * np.sqrt(spread) * np.sqrt(found)), 1, 100))


def _yaw(rotation: Array) -> float:
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))
