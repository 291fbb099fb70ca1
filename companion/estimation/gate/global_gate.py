"""Gate of global positions: what of the pose may be given out in latitude and longitude.

Never the autopilot's own satellites' echo. A map that satellites place repeats them: an autopilot
that was given such a position as one more sensor would count the same error twice, and would keep
a spoofed receiver's by our word. So the rule is:

- While satellites come, are believed and are not doubted, nothing is given out: they place the map.
- Once there were none for `WITHOUT_NS`, the map is where those of before have placed it, or a map
  that was kept of another flight, and what is added since is vision's alone. That may be given out,
  with the error that they had and that has grown since.
- With the first that is believed again it ceases at once.
- GPS_INPUT comes back as the autopilot's GPS. It is given out only where satellites are left out of
  `telemetry.use`, so that nothing that comes back ever places the map.
- The autopilot's own estimates place no map while this is on (`FeedbackConfig.gives_position`).
- Where poses are sent (`feedback.mode`), no global position is: the same error, twice. Beside
  their velocity alone it is: that knows nothing of where the map lies.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from companion.config import FeedbackConfig, Measurement
from companion.estimation.gate.pose_to_send import PoseToSend
from companion.geometry.geodesy import GeoOrigin, geodetic_from_ned
from companion.geometry.transforms import Array
from companion.messages import Georeference
from companion.telemetry import PositionSample, PositionSource, is_believed

WITHOUT_NS = 5_000_000_000
"""Time without satellites before ours are given out: receivers miss single fixes, and an autopilot
bridges some seconds by itself."""
SATELLITES_M = 1.5
"""Standard deviation of the position that satellites gave a map, at least: their errors wander
slowly, and do not average out."""
MAX_SIGMA_M = 50.0
"""A position known worse is no help."""

OTHER_SOURCE, ECHO, IN_USE = (
    "feedback.mode is on", "satellites are in telemetry.use", "satellites are in use",
)  # fmt: skip
NOT_PLACED, UNCERTAIN = "map has no place on earth", "position too uncertain"


@dataclass(frozen=True, slots=True, eq=False)
class GlobalToSend:
    """A position in WGS-84 degrees and metres above mean sea level, velocity (3,) in NED."""

    t_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    velocity_ned_m_s: Array
    sigma_horizontal_m: float
    sigma_vertical_m: float
    sigma_velocity_m_s: float


class GlobalGate:
    """Takes poses that the pose gate lets through; `why_not` is the reason of the last refusal."""

    def __init__(self, config: FeedbackConfig, use: Collection[Measurement]) -> None:
        self._config, self._use = config, use
        self.satellites_ns: int | None = None
        """Time of the last satellites that were used."""
        self._placed: Georeference | None = None
        self._placed_at_m: Array | None = None
        """Place of the body when satellites last placed the map."""
        self.doubted = False
        """True while satellites are doubted: those that come place nothing."""
        self.why_not = NOT_PLACED

    def reconfigure(self, config: FeedbackConfig) -> None:
        """Change the source that is given out."""
        self._config = config

    def take_position(self, sample: PositionSample) -> None:
        """Take a position of the autopilot; those of satellites count."""
        if sample.source is PositionSource.GPS and is_believed(sample, self._use):
            if not self.doubted:
                self.satellites_ns, self._placed_at_m = sample.t_ns, None

    def take_georeference(self, found: Georeference | None) -> None:
        """Take the newest place of the map."""
        self._placed = found

    def take(self, pose: PoseToSend, origin: GeoOrigin | None, now_ns: int) -> GlobalToSend | None:
        """The position to give out at the time of the call; `origin` is that of local NED."""
        position = pose.world_from_body.translation
        if self._placed_at_m is None:
            self._placed_at_m = position
        self.why_not = self._refusal(origin, now_ns)
        if self.why_not or origin is None or self._placed is None:
            return None
        flown_m = float(np.linalg.norm(position - self._placed_at_m))
        placed = self._placed
        sigma_m = float(np.hypot(pose.sigma_position_m, place_sigma_m(
            flown_m, placed.residual_m, placed.sigma_yaw_rad, placed.sigma_scale
        )))  # fmt: skip
        if not sigma_m <= MAX_SIGMA_M:
            self.why_not = UNCERTAIN
            return None
        latitude_deg, longitude_deg, altitude_m = geodetic_from_ned(position[None], origin)[0]
        return GlobalToSend(
            pose.t_ns, float(latitude_deg), float(longitude_deg), float(altitude_m),
            pose.velocity_world_m_s, sigma_m, sigma_m, pose.sigma_velocity_m_s,
        )  # fmt: skip

    def _refusal(self, origin: GeoOrigin | None, now_ns: int) -> str:
        if self._config.sends_position:
            return OTHER_SOURCE
        if self._config.global_position == "gps_input" and "satellites" in self._use:
            return ECHO
        if self.satellites_ns is not None and now_ns - self.satellites_ns < WITHOUT_NS:
            if not self.doubted:
                return IN_USE
        if origin is None or self._placed is None or not self._placed.has_origin:
            return NOT_PLACED
        return ""


def place_sigma_m(
    way_m: float, residual_m: float, sigma_yaw_rad: float, sigma_scale: float
) -> float:
    """Standard deviation of a place on earth, by a georeference, so far from where it was placed.

    `residual_m` is left between the path and the positions that it was placed by.
    """
    ways_m = max(residual_m, SATELLITES_M), sigma_yaw_rad * way_m, sigma_scale * way_m
    return float(np.linalg.norm(ways_m))
