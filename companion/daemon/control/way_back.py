"""The way back: the path since the motors were armed, as a mission for ground stations."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from companion.estimation.gate.global_gate import place_sigma_m
from companion.geometry.geodesy import GeoOrigin, geodetic_from_ned
from companion.geometry.thinned_path import ThinnedPath
from companion.geometry.transforms import Array
from companion.messages import Georeference, Georeferenced, Odometry, TrackState
from companion.pilot_messages import NO_WAY_BACK, WAY_BACK, PilotText
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink

SAME_NS = 1_000_000_000
"""Time for which what was made is given again, so that a storm of requests makes it once."""
NOTHING: Array = np.empty((0, 3))


class WayBack:
    """Odometry of the current flight in; waypoints from its newest place to the first out.

    Each place is kept as it was believed when it was flown, while the camera saw its way, the pose
    was good enough to be sent and the map had a place on the globe. A new map, or a crash of
    localisation, leaves them: they are of the same origin. `tell` takes what the pilot is to know,
    its details, and whether it is good.
    """

    def __init__(
        self, link: AutopilotLink, clock: FlightClock, armed: Callable[[], bool],
        min_quality: Callable[[], int], tell: Callable[[PilotText, str, bool], None],
    ) -> None:  # fmt: skip
        self._link, self._clock, self._armed, self._tell = link, clock, armed, tell
        self._min_quality = min_quality
        self._was_armed = False
        self._placed: Georeference | None = None
        self._path = ThinnedPath()
        self._origin: GeoOrigin | None = None
        self._made_ns: int | None = None
        self._made = NOTHING

    def take_georeference(self, told: Georeferenced) -> None:
        """Take the newest place of the map."""
        self._placed = told.georeference

    def take_odometry(self, odometry: Odometry) -> None:
        """Take the odometry of a frame."""
        armed, origin, pose = self._armed(), self._link.origin, odometry.world_from_body
        if armed and not self._was_armed:
            self._begin(origin)
        self._was_armed = armed
        is_placed = self._placed is not None and self._placed.has_origin and origin is not None
        if not armed or not is_placed or pose is None or odometry.state is not TrackState.TRACKING:
            return
        if odometry.quality < self._min_quality():
            return
        if origin != self._origin:
            self._begin(origin)
        self._path.add(pose.translation)

    def waypoints(self) -> Array:
        """Latitude, longitude and height (N, 3) of each; none where no path is known.

        ArduPilot's missions begin with home, which is no waypoint; so does this for it.
        """
        now_ns = self._clock.now_ns()
        if self._made_ns is None or now_ns - self._made_ns >= SAME_NS:
            self._made_ns, self._made = now_ns, self._now()
        return self._made

    def _begin(self, origin: GeoOrigin | None) -> None:
        self._path, self._origin, self._made_ns = ThinnedPath(), origin, None

    def _now(self) -> Array:
        places_m = self._path.places()[::-1]
        if self._origin is None or self._placed is None or not len(places_m):
            self._tell(NO_WAY_BACK(), "no way back: no path since arming has a place", False)
            return NOTHING
        length_m = float(np.linalg.norm(np.diff(places_m, axis=0), axis=1).sum())
        reach_m = float(np.linalg.norm(places_m - places_m[-1], axis=1).max())
        placed = self._placed
        sigma_m = place_sigma_m(
            reach_m, placed.residual_m, placed.sigma_yaw_rad, placed.sigma_scale
        )
        self._tell(
            WAY_BACK(n=str(len(places_m))),
            f"way back: {len(places_m)} waypoints, {length_m:.0f} m, within "
            f"{self._path.within_m:g} m of the path, placed within {sigma_m:.1f} m",
            True,
        )
        globe = geodetic_from_ned(places_m, self._origin)
        vehicle = self._link.vehicle
        has_home = vehicle is not None and vehicle.firmware == "ardupilot"
        return np.concatenate([globe[-1:], globe]) if has_home else globe
