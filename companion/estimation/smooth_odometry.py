"""Smooth odometry of the body, for an autopilot to fly on.

Scale, heading and position of the map are refined continuously, and each refinement moves the pose
of a stationary camera. Here the pose is continuous, and corrections are slew-limited.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from companion.estimation.inertial_navigation import AidedPlace, InertialNavigation, Reckoned
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose, yaw_rotation
from companion.messages import Georeference, Odometry, Track, TrackState

MAX_SLEW_M_S = 0.15
MAX_SLEW_RAD_S = np.radians(0.5)
MAX_ACCELERATION_M_S2 = 4.0
MIN_CONSISTENT_NS, MIN_CONSISTENT_FRAMES = 500_000_000, 3
"""Poses outside the innovation gate are accepted, as a reset, after agreeing with each other for so
long: longer than any gap bridged (feedback.max_gap_ms is at most 300), at any frame rate; and never
with fewer frames."""
DRIFT_WINDOW_NS = 10_000_000_000
SIGMA_DEAD_RECKONING_M_S = 0.3
"""Standard deviation of the velocity used in dead reckoning."""
MAX_SIGMA_RECKONED_M = 5.0
"""By inertial navigation; beyond, it is of no use even to find the map again."""
MAX_RECKONED_PLACES = 900
"""By inertial navigation in a row, one a frame: half a minute at 30 a second."""
MAX_SIGMA_SCALE_AIDING = 0.05
"""Of a map that aids inertial navigation: with a worse scale it would give a wrong velocity."""
SIGMA_RECKONED_RAD = np.radians(1.0)
"""Of the autopilot's attitude over some seconds."""
FLOOR_M, FLOOR_RAD = 0.02, np.radians(0.3)
SIGMA_DRIFT = 0.005
"""Ratio of path length: drift of a map before adjustment."""
NOISE_INFLATION = 3.0
"""Inflation for correlated errors of the matches of one image."""
FULL_COUNT = 150
GRID = 4


class _PathPoint(NamedTuple):
    """Position, path length, and accumulated slew correction at a time."""

    t_ns: int
    position: Array
    path_length_m: float
    slewed: Array


class _Drift(NamedTuple):
    """Standard deviations, m: by scale, by the map's drift, and by slew corrections.

    The last moved the pose but not the body.
    """

    by_scale_m: float
    by_map_m: float
    by_slew_m: float


class _RejectedPoses(NamedTuple):
    """Poses outside the innovation gate since the last accepted one.

    The newest `n` of them, from `agreed_since_ns` to `t_ns`, agree with each other; the newest is
    at `position`.
    """

    since_ns: int
    agreed_since_ns: int
    t_ns: int
    position: Array
    n: int


class BodyAttitude(NamedTuple):
    """Attitude `ned_from_body` (3, 3) of a frame, at its time by the autopilot's stamps."""

    t_ns: int
    ned_from_body: Array


class MapView(NamedTuple):
    """Time of a keyframe, and its pose in the map."""

    t_ns: int
    map_from_camera: Pose


class BodyPlace(NamedTuple):
    """Place (3,) of the body by inertial navigation, world NED, metres; sigma of its velocity."""

    t_ns: int
    place_world_m: Array
    sigma_velocity_m_s: float


class OdometryState(NamedTuple):
    """State to continue in the same frame: see `SmoothOdometry.resume`."""

    odometry_from_world: Pose
    anchored: bool
    position_m: Array
    """Position (3,) of the body in the odometry frame when last tracked."""
    velocity_m_s: Array
    """Velocity (3,) of the body in the odometry frame at that time."""


class SmoothOdometry:
    """Tracks of the active map and its georeference in, Odometry out; one per frame.

    Tracked places aid the inertial navigation, which carries the pose on where nothing is tracked.
    """

    def __init__(self, camera: Camera, max_jump_m: float, navigation: InertialNavigation) -> None:
        mount = camera.body_from_camera
        self._camera_from_body = mount.inverse() if mount is not None else Pose.identity()
        self._size = np.array([camera.width, camera.height], np.float64)
        self._max_jump_m = max_jump_m
        self._navigation = navigation
        self._owed_m = np.zeros(3)
        """Of the last reacquisition, not slewed yet."""
        self._attitude: BodyAttitude | None = None
        self._reckoned: Reckoned | None = None
        """Attitude of the frame that has begun, and where inertial navigation has the body."""
        self._reckoned_world: deque[BodyPlace] = deque(maxlen=MAX_RECKONED_PLACES)
        self._segment: int | None = None
        self._georeference: Georeference | None = None
        self._odometry_from_world = Pose.identity()
        self._last: tuple[int, Pose, Pose] | None = None
        """Time, `map_from_camera` and `odometry_from_body` of the last accepted frame."""
        self._anchored = False
        self._velocity = np.zeros(3)
        self._rejected: _RejectedPoses | None = None
        self._dead_reckoning = False
        self._path: deque[_PathPoint] = deque()
        self._slewed = np.zeros(3)
        self.reset_counter = 0

    def step(
        self,
        track: Track,
        segment: int,
        georeference: Georeference | None,
        velocity_map: tuple[Array, float] | None,
        first: MapView | None = None,
    ) -> Odometry:
        """Odometry of the frame that has begun.

        `segment` identifies the map of the track, `georeference` is that of this map,
        `velocity_map` the camera velocity in it with its standard deviation, and `first` its first
        view.
        """
        pose = track.map_from_camera
        known = track.state in (TrackState.TRACKING, TrackState.DEAD_RECKONING)
        if not known or pose is None or georeference is None:
            return self._unknown(track)
        if segment != self._segment or self._georeference is None:
            self._start_map(segment, georeference, pose, first)
        elif georeference is not self._georeference:
            self._update_georeference(georeference)
        raw = self._raw(georeference, pose)
        if track.state is TrackState.DEAD_RECKONING:
            if self._reckoned is not None:
                return self._unknown(track)
            return self._dead_reckon(track, raw)
        if self._dead_reckoning:
            self._reacquire(raw, track.t_ns)
        before = self._odometry_from_world, self._slewed
        here = self._odometry_from_world @ raw
        self._slew(raw, track.t_ns)
        placed = self._odometry_from_world @ raw
        within_gate = self._within_gate(placed, track.t_ns)
        if not within_gate and not self._consistent(placed, track.t_ns):
            self._odometry_from_world, self._slewed = before
            return self._unknown(track)
        rejected_ns = track.t_ns - self._rejected.since_ns if self._rejected is not None else 0
        if not within_gate or rejected_ns >= MIN_CONSISTENT_NS:
            self.reset_counter += 1
            self._path.clear()
            self._navigation.reset()
        self._rejected = None
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
        if self._reckoned is not None and self._reckoned.sigma_velocity_m_s < sigma_velocity:
            self._velocity = self._reckoned.velocity_m_s
            sigma_velocity = self._reckoned.sigma_velocity_m_s
        self._last = (track.t_ns, pose, placed)
        noise_m = NOISE_INFLATION * track.sigma_position * georeference.world_from_map.scale
        self._navigation.move(
            placed.rotation @ here.rotation.T, here.translation, placed.translation, 1.0
        )
        attitude = self._attitude
        if attitude is not None and georeference.sigma_scale < MAX_SIGMA_SCALE_AIDING:
            turned = placed.rotation @ attitude.ned_from_body.T
            self._navigation.aid(AidedPlace(attitude.t_ns, placed.translation, turned, noise_m))
        drift = self._drift_sigma_m(track.t_ns, placed.translation, georeference.sigma_scale)
        return Odometry(
            track.seq, track.t_ns, track.state, self.reset_counter, self._quality(track), placed,
            self._velocity.copy(),
            float(np.linalg.norm([FLOOR_M, noise_m, *drift])),
            sigma_velocity,
            float(np.hypot(FLOOR_RAD, NOISE_INFLATION * track.sigma_rotation_rad)),
            self._sigma_yaw_rad(georeference, NOISE_INFLATION * track.sigma_rotation_rad),
            sigma_scale=georeference.sigma_scale, sigma_by_scale_m=drift.by_scale_m,
        )  # fmt: skip

    def _sigma_yaw_rad(self, georeference: Georeference, noise_rad: float) -> float:
        """Standard deviation of the heading against north.

        Of the georeference, of the difference to it that is not slewed yet, and noise.
        """
        apart_rad = _yaw(self._odometry_from_world.rotation)
        return float(np.linalg.norm([FLOOR_RAD, noise_rad, georeference.sigma_yaw_rad, apart_rad]))

    def _drift_sigma_m(self, t_ns: int, position: Array, sigma_scale: float) -> _Drift:
        """Drift standard deviations over the last seconds, along each axis."""
        path_length_m = 0.0
        if self._path:
            path_length_m = self._path[-1].path_length_m + float(
                np.linalg.norm(position - self._path[-1].position)
            )
        self._path.append(_PathPoint(t_ns, position, path_length_m, self._slewed))
        while self._path[0].t_ns < t_ns - DRIFT_WINDOW_NS:
            self._path.popleft()
        since = self._path[0]
        return _Drift(
            sigma_scale * float(np.linalg.norm(position - since.position)),
            SIGMA_DRIFT * (path_length_m - since.path_length_m),
            float(np.linalg.norm(self._slewed - since.slewed)) / np.sqrt(3.0),
        )

    def begin(self, t_ns: int, attitude: BodyAttitude | None) -> Reckoned | None:
        """Go on by inertial navigation to the next frame, with its attitude where that is known.

        Where the body should be then, in the frame of the odometry; None where unknown, or too
        uncertain to be of use.
        """
        found = None if attitude is None else self._navigation.at(attitude.t_ns)
        if found is not None and found.sigma_place_m > MAX_SIGMA_RECKONED_M:
            found = None
        self._attitude, self._reckoned = attitude, found
        if found is not None:
            world_m = self._odometry_from_world.inverse().apply(found.place_m)
            place = BodyPlace(t_ns, np.asarray(world_m), found.sigma_velocity_m_s)
            self._reckoned_world.append(place)
        return found

    def reckoned_world(self, t_ns: int) -> BodyPlace | None:
        """Place by inertial navigation at one of the latest frames; None if that had none."""
        return next((each for each in self._reckoned_world if each.t_ns == t_ns), None)

    def _dead_reckon(self, track: Track, raw: Pose) -> Odometry:
        """Odometry by dead reckoning: of lowest quality and growing uncertainty."""
        assert track.map_from_camera is not None
        placed = self._odometry_from_world @ raw
        if self._last is not None:
            dt_s = max((track.t_ns - self._last[0]) * 1e-9, 1e-3)
            self._velocity = (placed.translation - self._last[2].translation) / dt_s
        self._dead_reckoning = True
        self._last = (track.t_ns, track.map_from_camera, placed)
        assert self._georeference is not None
        scale = self._georeference.world_from_map.scale
        return Odometry(
            track.seq, track.t_ns, track.state, self.reset_counter, 1, placed,
            self._velocity.copy(), max(FLOOR_M, scale * track.sigma_position),
            SIGMA_DEAD_RECKONING_M_S, float(np.hypot(FLOOR_RAD, track.sigma_rotation_rad)),
            self._sigma_yaw_rad(self._georeference, track.sigma_rotation_rad),
        )  # fmt: skip

    def _reacquire(self, raw: Pose, t_ns: int) -> None:
        """Reacquisition after dead reckoning: continue from its pose, if close enough.

        What the pose is then off by is slewed away.
        """
        self._dead_reckoning = False
        if self._last is None:
            return
        expected = self._last[2].translation + self._velocity * ((t_ns - self._last[0]) * 1e-9)
        if self._reckoned is not None:
            expected = self._reckoned.place_m
        correction = expected - (self._odometry_from_world @ raw).translation
        if float(np.linalg.norm(correction)) < self._max_jump_m:
            before = self._odometry_from_world
            self._odometry_from_world = Pose(before.rotation, before.translation + correction)
            self._owed_m = self._owed_m - correction

    def place_in_map(self, place_m: Array, map_from_camera: Array) -> Array | None:
        """Place of the camera (3,) in the active map, for a place (3,) of the body.

        The place is in the frame of the odometry, metres; the rotation (3, 3) is the camera's in
        the map. None without a georeference.
        """
        if self._georeference is None:
            return None
        to_world = self._georeference.world_from_map
        world_m = self._odometry_from_world.inverse().apply(place_m)
        lever_m = to_world.rotation @ map_from_camera @ self._camera_from_body.translation
        return np.asarray(to_world.inverse().apply(world_m - lever_m))

    def _unknown(self, track: Track) -> Odometry:
        """Odometry without a pose by the map: by inertial navigation, as far as that knows it."""
        attitude, reckoned = self._attitude, self._reckoned
        if attitude is None or reckoned is None or self._georeference is None:
            return Odometry(track.seq, track.t_ns, track.state, self.reset_counter)
        rotation = self._navigation.world_from_attitude @ attitude.ned_from_body
        placed, self._velocity = Pose(rotation, reckoned.place_m), reckoned.velocity_m_s
        self._dead_reckoning = True
        georeference = self._georeference
        if self._last is not None:
            camera = self._odometry_from_world.inverse() @ placed @ self._camera_from_body.inverse()
            pose = georeference.world_from_map.inverse().apply_to_pose(camera)
            self._last = (track.t_ns, pose, placed)
        drift = self._drift_sigma_m(track.t_ns, placed.translation, georeference.sigma_scale)
        return Odometry(
            track.seq, track.t_ns, TrackState.DEAD_RECKONING, self.reset_counter, 1, placed,
            reckoned.velocity_m_s,
            float(np.linalg.norm([FLOOR_M, reckoned.sigma_place_m, *drift])),
            reckoned.sigma_velocity_m_s, float(SIGMA_RECKONED_RAD),
            self._sigma_yaw_rad(georeference, float(SIGMA_RECKONED_RAD)), inertial=True,
            sigma_scale=georeference.sigma_scale, sigma_by_scale_m=drift.by_scale_m,
        )  # fmt: skip

    def _raw(self, georeference: Georeference, map_from_camera: Pose) -> Pose:
        """`world_from_body` by the map at present."""
        return georeference.world_from_map.apply_to_pose(map_from_camera) @ self._camera_from_body

    def _start_map(
        self, segment: int, georeference: Georeference, pose: Pose, first: MapView | None
    ) -> None:
        """Start in another map, or the first one; poses are unrelated to the last.

        A map without an origin continues from where inertial navigation had the body at its first
        view, else from the last known position.
        """
        offset = np.zeros(3)
        if self._last is not None:
            self.reset_counter += 1
            reckoned = None if first is None else self.reckoned_world(first.t_ns)
            if georeference.has_origin:
                self._navigation.reset()
            elif first is not None and reckoned is not None:
                place_m = self._odometry_from_world.apply(reckoned.place_world_m)
                offset = place_m - self._raw(georeference, first.map_from_camera).translation
            else:
                offset = self._last[2].translation - self._raw(georeference, pose).translation
        self._reckoned_world.clear()
        self._owed_m = np.zeros(3)
        self._odometry_from_world = Pose(np.eye(3), offset)
        self._anchored = georeference.has_origin
        self._segment, self._georeference = segment, georeference
        self._last = None
        self._rejected = None
        self._dead_reckoning = False
        self._path.clear()

    def _update_georeference(self, georeference: Georeference) -> None:
        """Change the georeference of the same map, keeping the last pose."""
        before = self._georeference
        if self._last is not None and before is not None:
            _, pose, placed = self._last
            raw = self._raw(georeference, pose)
            yaw_offset = yaw_rotation(_yaw(placed.rotation @ raw.rotation.T))
            self._odometry_from_world = Pose(
                yaw_offset, placed.translation - yaw_offset @ raw.translation
            )
            ratio = georeference.world_from_map.scale / before.world_from_map.scale
            self._navigation.move(np.eye(3), placed.translation, placed.translation, ratio)
        self._georeference = georeference

    @property
    def state(self) -> OdometryState | None:
        """State to continue from; None before the first pose."""
        if self._last is None:
            return None
        return OdometryState(
            self._odometry_from_world, self._anchored, self._last[2].translation.copy(),
            self._velocity.copy(),
        )  # fmt: skip

    def resume(self, segment: int, georeference: Georeference, state: OdometryState) -> None:
        """Continue in a stored frame; `segment` and `georeference` are of the map stored with it.

        The next pose is taken as is, since the motion meanwhile is unknown.
        """
        self._segment, self._georeference = segment, georeference
        self._odometry_from_world, self._anchored = state.odometry_from_world, state.anchored
        self._last, self._rejected, self._dead_reckoning = None, None, False
        self._path.clear()
        self._owed_m = np.zeros(3)
        self._navigation.reset()

    def correct_map(self, map_from_camera: Pose) -> None:
        """Apply a correction of the map: `map_from_camera` of the last accepted frame now.

        The output stays continuous; the difference is slewed.
        """
        if self._last is None or self._georeference is None or self._dead_reckoning:
            return  # what dead reckoning is off by shows when the map is seen again
        t_ns, _, placed = self._last
        self._last = (t_ns, map_from_camera, placed)
        self._update_georeference(self._georeference)

    def _slew(self, raw: Pose, t_ns: int) -> None:
        """Slew towards the pose by the map, where that started with a world position.

        A map that started without one stays in its frame, but for what a reacquisition owes: the
        correction may be large, and an autopilot would fly it.
        """
        if self._last is None:
            return
        dt_s = min((t_ns - self._last[0]) * 1e-9, 1.0)
        if not self._anchored:
            owed_m = float(np.linalg.norm(self._owed_m))
            step = self._owed_m * min(1.0, MAX_SLEW_M_S * dt_s / max(owed_m, 1e-12))
            before = self._odometry_from_world
            self._odometry_from_world = Pose(before.rotation, before.translation + step)
            self._owed_m, self._slewed = self._owed_m - step, self._slewed + step
            return
        here = self._odometry_from_world @ raw
        yaw = _yaw(self._odometry_from_world.rotation)
        most = float(MAX_SLEW_RAD_S) * dt_s
        yaw_offset = yaw_rotation(yaw - float(np.clip(yaw, -most, most)))
        away = here.translation - raw.translation
        far = float(np.linalg.norm(away))
        remaining = max(far - MAX_SLEW_M_S * dt_s, 0.0) / max(far, 1e-12)
        at = raw.translation + remaining * away
        self._slewed = self._slewed + at - here.translation
        self._odometry_from_world = Pose(yaw_offset, at - yaw_offset @ raw.translation)

    def _within_gate(self, placed: Pose, t_ns: int) -> bool:
        """Innovation gate: whether motion can have brought the body here."""
        if self._last is None:
            return True
        return self._reachable(self._last[2].translation, placed.translation, t_ns - self._last[0])

    def _consistent(self, placed: Pose, t_ns: int) -> bool:
        """Add a pose outside the gate; whether enough of them agree."""
        position, rejected = placed.translation, self._rejected
        if rejected is None or not self._reachable(
            rejected.position, position, t_ns - rejected.t_ns
        ):
            self._rejected = _RejectedPoses(
                rejected.since_ns if rejected else t_ns, t_ns, t_ns, position, 1
            )
            return False
        self._rejected = rejected = rejected._replace(
            t_ns=t_ns, position=position, n=rejected.n + 1
        )
        return (
            t_ns - rejected.agreed_since_ns >= MIN_CONSISTENT_NS
            and rejected.n >= MIN_CONSISTENT_FRAMES
        )

    def _reachable(self, before: Array, after: Array, dt_ns: int) -> bool:
        """True if the body can have moved between two positions (3,), world, metres, in `dt_ns`."""
        dt_s = dt_ns * 1e-9
        expected = before + self._velocity * min(dt_s, 1.0)
        away_m = float(np.linalg.norm(after - expected))
        speed = float(np.linalg.norm(self._velocity))
        beyond_s = max(dt_s - 1.0, 0.0)
        return away_m < self._max_jump_m + 0.5 * MAX_ACCELERATION_M_S2 * dt_s**2 + speed * beyond_s

    def _quality(self, track: Track) -> int:
        """1..100, from the number, image coverage and match ratio of inliers."""
        if track.keypoints_px is None or not len(track.keypoints_px):
            return 1
        cells = np.clip((track.keypoints_px / self._size * GRID).astype(int), 0, GRID - 1)
        spread = len(np.unique(cells @ [1, GRID])) / GRID**2
        count = min(1.0, track.n_inliers / FULL_COUNT)
        found = track.n_inliers / max(track.n_matches, 1)
        return int(np.clip(round(100 * count * np.sqrt(spread) * np.sqrt(found)), 1, 100))


def _yaw(rotation: Array) -> float:
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))
