"""Whether a map from before is what the camera sees now, before anything is believed by it.

A place is recognised by one image as a lost camera recognises it; a map of a process that is gone
must moreover hold over several frames, lie to the autopilot's attitude as it lay before, and have
the body where it can have got to.
"""

from __future__ import annotations

from enum import Enum

import numpy as np

from companion.estimation.checkpoint import Checkpoint
from companion.estimation.smooth_odometry import MAX_ACCELERATION_M_S2
from companion.geometry.transforms import Array, Pose, angle_between
from companion.messages import Track
from companion.slam.loop.relocalizer import MIN_FOUND

MOST_ABSENT_NS = 60_000_000_000
"""What was kept longer ago is of another flight, or of another place by now."""
TRIED_NS = 5_000_000_000
"""Another map may begin after so long; its scale would take as long to be known."""
MIN_FRAMES, MIN_SPAN_NS = 5, 300_000_000
"""A map is taken up when so many frames in a row agree with it, over so long;"""
UNTOLD = 3
"""so many times that where no attitude was ever told."""
MAX_TURNED_RAD = np.radians(8.0)
"""What the autopilot's heading may have wandered by meanwhile, and its vertical be off by."""
MAX_AWAY_M = 2.0
"""What a last place and the place recognised may be wrong by together."""


class Verdict(Enum):
    """What is thought of the map from before."""

    TRYING = "trying"
    PROVEN = "proven"
    REFUSED = "refused"


class Resumption:
    """Frames that were placed in the map from before, in; what to think of it, out.

    `begin_ns` is the time of the first frame, `absent_ns` how long before it the last was tracked.
    """

    def __init__(self, kept: Checkpoint, begin_ns: int, absent_ns: int) -> None:
        self.kept, self.absent_ns = kept, absent_ns
        self.why_not = "nothing that is seen now is in it"
        self.until_ns = begin_ns + TRIED_NS
        self._last_seen_ns = begin_ns - absent_ns
        self._agreeing: list[int] = []
        """Times of frames in a row that agreed."""

    def judge(
        self, t_ns: int, track: Track | None, ned_from_camera: Array | None, camera_from_body: Pose
    ) -> Verdict:
        """Take a frame: its track where it was placed, and its attitude (3, 3) where told.

        Where the attitude is yet to come, as from a link that is being opened, that is waited for;
        so is a place that is not seen yet, for as long as no other map has begun.
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
            old = t_ns - self._last_seen_ns > MOST_ABSENT_NS
            return Verdict.REFUSED if late or old else Verdict.TRYING
        times = 1 if self.kept.ned_from_map is not None else UNTOLD
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
            if turned_rad > float(MAX_TURNED_RAD):
                off_deg = np.degrees(turned_rad)
                self.why_not = f"the autopilot's attitude differs by {off_deg:.0f} degrees"
                return False
        away_m = self._beyond_reach_m(track.t_ns, map_from_camera, camera_from_body)
        if away_m > 0.0:
            self.why_not = f"it would have the body {away_m:.0f} m beyond its reach"
            return False
        return True

    def _beyond_reach_m(self, t_ns: int, map_from_camera: Pose, camera_from_body: Pose) -> float:
        """How much further the body would have come than it can have; 0 without a scale."""
        found, odometry = self.kept.georeference, self.kept.odometry
        if found is None or odometry is None:
            return 0.0
        world_from_body = found.world_from_map.apply_to_pose(map_from_camera) @ camera_from_body
        place_m = odometry.odometry_from_world.apply(world_from_body.translation)
        away_s = (t_ns - self._last_seen_ns) * 1e-9
        speed_m_s = float(np.linalg.norm(odometry.velocity_m_s))
        reach_m = MAX_AWAY_M + speed_m_s * away_s + 0.5 * MAX_ACCELERATION_M_S2 * away_s**2
        return max(0.0, float(np.linalg.norm(place_m - odometry.place_m)) - reach_m)
