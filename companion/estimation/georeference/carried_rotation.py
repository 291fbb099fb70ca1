"""Rotation of a map carried over from the map before or after it, across a short gap.

Positions along a straight path leave the roll about it unknown: of a climb, the heading. Where no
attitude is measured and the maps share no place, the camera's own rotation is what both have in
common: it is taken as held through the gap, and as uncertain as the turns seen about it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from companion.estimation.georeference.trajectory_alignment import Level
from companion.geometry.transforms import Array, Similarity, angle_between
from companion.slam.map.sparse_map import Keyframe, SlamMap

MAX_GAP_NS = 2_000_000_000
"""A camera lost for longer may have turned and stopped again unseen."""
TURNS_NS = 1_000_000_000
"""Before and after a gap, in which turns are looked for: one that is about to begin shows there."""
LEAST_RATE_RAD_S = np.radians(3.0)
"""Rate of turn that a vehicle on a steady way is not known better than, in wind."""
MAX_SIGMA_RAD = np.radians(8.0)
"""As of a rotation by positions alone."""


def carried_level(segment: SlamMap, placed: Sequence[tuple[SlamMap, Similarity]]) -> Level | None:
    """Rotation of a map by those `placed` beside it in time, with their `world_from_map`.

    None where none is near enough in time or the camera turned too fast about the gap.
    """
    own = _by_time(segment)
    found = []
    for other, world_from_other in placed:
        theirs = _by_time(other)
        before = [k for k in theirs if k.t_ns < own[0].t_ns]
        after = [k for k in theirs if k.t_ns > own[-1].t_ns]
        if before:
            found.append(_across(own, before[::-1], world_from_other.rotation))
        if after:
            found.append(_across(own[::-1], after, world_from_other.rotation))
    best = min(found, key=lambda level: level.sigma_yaw_rad, default=None)
    return None if best is None or best.sigma_yaw_rad > float(MAX_SIGMA_RAD) else best


def _by_time(segment: SlamMap) -> list[Keyframe]:
    return sorted(segment.keyframes.values(), key=lambda k: k.t_ns)


def _across(own: list[Keyframe], theirs: list[Keyframe], world_from_other: Array) -> Level:
    """Rotation carried from the first of `theirs` to the first of `own`, both by distance in time.

    Its sigma is infinite across a gap that is too long.
    """
    here, there = own[0], theirs[0]
    gap_ns = abs(here.t_ns - there.t_ns)
    rate_rad_s = max(_rate(own), _rate(theirs), float(LEAST_RATE_RAD_S))
    sigma_rad = rate_rad_s * gap_ns * 1e-9 if gap_ns <= MAX_GAP_NS else np.inf
    rotation = world_from_other @ there.camera_from_map.rotation.T @ here.camera_from_map.rotation
    return Level(rotation, sigma_rad, sigma_rad)


def _rate(keyframes: Iterable[Keyframe]) -> float:
    """Fastest turn, rad/s, from one keyframe to the next within a second of the first.

    Infinite of a single one, which shows no turn.
    """
    first, *others = keyframes
    rate_rad_s, before = np.inf if not others else 0.0, first
    for k in others:
        if before is not first and abs(k.t_ns - first.t_ns) > TURNS_NS:
            break
        turned_rad = angle_between(k.camera_from_map.rotation, before.camera_from_map.rotation)
        rate_rad_s = max(rate_rad_s, turned_rad / (abs(k.t_ns - before.t_ns) * 1e-9))
        before = k
    return rate_rad_s
