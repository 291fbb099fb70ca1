"""Verification of a stored map against present frames, before it is used.

A single image is relocalised as after tracking loss; a map of a previous process must moreover
agree over several frames, with the attitude as before, and with a position that the body can have
reached.
"""

from __future__ import annotations

from enum import Enum

import numpy as np

from companion.estimation.odometry.jump_gate import MAX_ACCELERATION_M_S2
from companion.estimation.resumption.checkpoint import Checkpoint
from companion.geometry.transforms import Array, Pose, angle_between
from companion.messages import Track
from companion.slam.loop.relocalizer import MIN_FOUND

MAX_ABSENT_NS = 60_000_000_000
"""An older map is of another flight, or too far away by now."""
TIMEOUT_NS = 5_000_000_000
"""Time after which another map may be initialised; its scale would take as long."""
MIN_FRAMES, MIN_SPAN_NS = 5, 300_000_000
"""Successive agreeing frames required, and their least span."""
NO_ATTITUDE_FACTOR = 3
"""Factor on both without attitude."""
MAX_ATTITUDE_ERROR_RAD = np.radians(8.0)
"""Heading drift of the autopilot meanwhile, and error of its vertical."""
MAX_POSITION_ERROR_M = 2.0
"""Combined error of the last and the relocalised position."""


class Verdict(Enum):
    """State of the verification."""

    TRYING = "trying"
    PROVEN = "proven"
    REFUSED = "refused"


class Resumption:
    """Verifies frames that were relocalised in the stored map.

    `begin_ns` is the time of the first frame, `absent_ns` the time since the last tracked one.
    """

    def __init__(self, kept: Checkpoint, begin_ns: int, absent_ns: int) -> None:
        self.kept, self.absent_ns = kept, absent_ns
        self.why_not = "nothing that is seen now is in it"
        self.until_ns = begin_ns + TIMEOUT_NS
        self._last_seen_ns = begin_ns - absent_ns
        self._agreeing: list[int] = []
        """Times of successive agreeing frames."""

    def check(
        self, t_ns: int, track: Track | None, ned_from_camera: Array | None, camera_from_body: Pose
    ) -> Verdict:
        """Process a frame: its track where relocalised, and its attitude (3, 3) where measured.

        A missing attitude, as from a link being opened, is waited for; so is relocalisation, until
        another map may be initialised.
        """
        if track is None or track.map_from_camera is None:
            self._agreeing.clear()
        elif self.kept.ned_from_map is not None and ned_from_camera is None:
            self._agreeing.clear()
            self.why_not = "the autopilot's attitude is missing"
            return Verdict.TRYING
        elif self._agrees(track, track.map_from_camera, ned_from_camera, camera_from_body):
            self._agreeing.append(t_ns)
        else:
            self._agreeing.clear()
        if not self._agreeing:
            late = t_ns >= self.until_ns and track is not None
            old = t_ns - self._last_seen_ns > MAX_ABSENT_NS
            return Verdict.REFUSED if late or old else Verdict.TRYING
        times = 1 if self.kept.ned_from_map is not None else NO_ATTITUDE_FACTOR
        span_ns = self._agreeing[-1] - self._agreeing[0]
        if len(self._agreeing) >= times * MIN_FRAMES and span_ns >= times * MIN_SPAN_NS:
            return Verdict.PROVEN
        return Verdict.TRYING

    def _agrees(
        self, track: Track, map_from_camera: Pose, ned_from_camera: Array | None,
        camera_from_body: Pose,
    ) -> bool:  # fmt: skip
        if track.n_inliers < MIN_FOUND:
            self.why_not = "too little of it is seen"
            return False
        if self.kept.ned_from_map is not None and ned_from_camera is not None:
            ned_from_map = ned_from_camera @ map_from_camera.rotation.T
            turned_rad = angle_between(ned_from_map, self.kept.ned_from_map)
            if turned_rad > float(MAX_ATTITUDE_ERROR_RAD):
                off_deg = np.degrees(turned_rad)
                self.why_not = f"the autopilot's attitude differs by {off_deg:.0f} degrees"
                return False
        excess_m = self._excess_distance_m(track.t_ns, map_from_camera, camera_from_body)
        if excess_m > 0.0:
            self.why_not = f"it would have the body {excess_m:.0f} m beyond its reach"
            return False
        return True

    def _excess_distance_m(self, t_ns: int, map_from_camera: Pose, camera_from_body: Pose) -> float:
        """Distance of the body beyond its reachable range; 0 without a scale."""
        found, odometry = self.kept.georeference, self.kept.odometry
        if found is None or odometry is None:
            return 0.0
        world_from_body = found.world_from_map.apply_to_pose(map_from_camera) @ camera_from_body
        position_m = odometry.odometry_from_world.apply(world_from_body.translation)
        away_s = (t_ns - self._last_seen_ns) * 1e-9
        speed_m_s = float(np.linalg.norm(odometry.velocity_m_s))
        reach_m = (
            MAX_POSITION_ERROR_M + speed_m_s * away_s + 0.5 * MAX_ACCELERATION_M_S2 * away_s**2
        )
        return max(0.0, float(np.linalg.norm(position_m - odometry.position_m)) - reach_m)
