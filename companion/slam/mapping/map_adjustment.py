"""What is adjusted together: taken out of the map, adjusted on its own, and put back.

Between the two the map may go on: what changed or came meanwhile is moved along with what was
adjusted, so that putting back is one step and nothing tears.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array, Pose
from companion.slam.features.orb_features import Bools, Ints
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.optimisation.bundle_adjustment import Adjusted, Bundle
from companion.slam.optimisation.displacement_factor import Ways
from companion.slam.optimisation.factors import Tie
from companion.slam.optimisation.gravity_factor import Plumb, plumb_of
from companion.slam.optimisation.rotation_factor import turns_of

MOST_TOGETHER, MOST_HOLDING = 500, 80
"""Keyframes adjusted at once, for which memory grows with the square, and those that hold them."""
MAX_TURN_NS = 2_000_000_000
"""Gyroscopes tell a turn that took longer no better than the vertical and the compass do."""


@dataclass(frozen=True, slots=True, eq=False)
class Taken:
    """Keyframes (the first `bundle.n_variable` of which move) and points as they were.

    `features` (O,) are those of the bundle's observations; `born` (P,) tells whether the index of a
    point has been given to another since.
    """

    bundle: Bundle
    keyframes: list[Keyframe]
    features: Ints
    points: Ints
    born: Ints


WaysOf = Callable[[SlamMap, list[Keyframe]], Ways | None]
"""What is told of how far a map's cameras are apart; None where nothing is."""


def no_ways(slam_map: SlamMap, keyframes: list[Keyframe]) -> None:
    """Nothing is told."""


def take(
    slam_map: SlamMap, variable: list[Keyframe], fixed: list[Keyframe], mask: Bools,
    ways_of: WaysOf = no_ways,
) -> Taken | None:  # fmt: skip
    """Keyframes and, of the points in `mask` (N,), those that two of them see; None if too few."""
    cameras, obs_cam, obs_feat, obs_id = [*variable, *fixed], [], [], []
    for i, k in enumerate(cameras):
        features, ids = slam_map.seen_by(k)
        wanted = mask[ids]
        obs_feat.append(features[wanted])
        obs_id.append(ids[wanted])
        obs_cam.append(np.full(int(wanted.sum()), i))
    ids = np.concatenate(obs_id)
    counts = np.bincount(ids, minlength=slam_map.n_points)
    keep = counts[ids] >= 2
    cam, feat, ids = np.concatenate(obs_cam)[keep], np.concatenate(obs_feat)[keep], ids[keep]
    if len(ids) < 30:
        return None
    points, index = np.unique(ids, return_inverse=True)
    bundle = Bundle(
        [k.camera_from_map for k in cameras], len(variable), slam_map.positions[points],
        cam, index,
        np.concatenate([k.normalised[feat[cam == i]] for i, k in enumerate(cameras)]),
        np.concatenate([k.whitening[feat[cam == i]] for i, k in enumerate(cameras)]),
        _ties(slam_map, cameras, ways_of(slam_map, cameras)),
    )  # fmt: skip
    return Taken(bundle, cameras, feat, points, slam_map.born[points])


def _ties(slam_map: SlamMap, cameras: list[Keyframe], ways: Ways | None) -> list[Tie]:
    """What the autopilot tells of cameras: the vertical, or first their turns, and ways between."""
    everywhere, attitudes = list(slam_map.keyframes.values()), _attitudes(cameras)
    rotation = np.stack([k.camera_from_map.rotation for k in everywhere])
    down = plumb_of(rotation, _attitudes(everywhere)[:, 2])
    if down is not None:
        told: Tie | None = Plumb(attitudes[:, 2], *down)
    else:
        t_ns = np.array([k.t_ns for k in cameras])
        order = np.argsort(t_ns, kind="stable")
        soon = np.diff(t_ns[order]) < MAX_TURN_NS
        told = turns_of(order[:-1][soon], order[1:][soon], attitudes)
    return [tie for tie in (told, ways) if tie is not None]


def _attitudes(keyframes: list[Keyframe]) -> Array:
    untold = np.full((3, 3), np.nan)
    return np.stack([untold if k.ned_from_camera is None else k.ned_from_camera for k in keyframes])


def put_back(slam_map: SlamMap, taken: Taken, result: Adjusted) -> None:
    """Put back what was adjusted, the map being as it was."""
    for keyframe, pose in zip(
        taken.keyframes[: taken.bundle.n_variable], result.poses, strict=False
    ):
        keyframe.camera_from_map = pose
    slam_map.poses_changed()
    slam_map.positions[taken.points] = result.points
    _forget_wrong(slam_map, taken, result)


def put_back_later(slam_map: SlamMap, taken: Taken, result: Adjusted) -> None:
    """Put back what was adjusted into a map that has gone on since."""
    before = slam_map.positions[: slam_map.n_points].copy()
    moves = _moves(slam_map, taken, result)
    for key, keyframe in slam_map.keyframes.items():
        keyframe.camera_from_map = keyframe.camera_from_map @ moves[key].inverse()
    slam_map.poses_changed()
    same = slam_map.alive[taken.points] & (slam_map.born[taken.points] == taken.born)
    known = taken.points[same]
    slam_map.positions[known] = before[known] + (result.points - taken.bundle.points)[same]
    fresh = slam_map.alive[: slam_map.n_points].copy()
    fresh[known] = False
    ids = np.flatnonzero(fresh)
    homes = slam_map.first_seen[ids]
    for home in np.unique(homes).tolist():
        retired = slam_map.retired.get(home)
        move = moves.get(home if retired is None else retired.beside_id)
        if move is not None:
            own = ids[homes == home]
            slam_map.positions[own] = move.apply(before[own])
    _forget_wrong(slam_map, taken, result)


def _moves(slam_map: SlamMap, taken: Taken, result: Adjusted) -> dict[int, Pose]:
    """How every keyframe of the map is moved in it; a new one as that which shows most of it."""
    moves = {
        k.keyframe_id: after.inverse() @ before
        for k, before, after in zip(
            taken.keyframes, taken.bundle.poses, result.poses, strict=True
        )
    }
    last = moves[max(moves)]
    for key, keyframe in slam_map.keyframes.items():
        if key not in moves:
            _, points = slam_map.seen_by(keyframe)
            alike = (k for _, k in slam_map.covisible(points) if k in moves and k != key)
            moves[key] = moves.get(next(alike, -1), last)
    return moves


def _forget_wrong(slam_map: SlamMap, taken: Taken, result: Adjusted) -> None:
    wrong = ~result.inlier
    for i, keyframe in enumerate(taken.keyframes):
        of = wrong & (taken.bundle.camera == i)
        bad = taken.features[of]
        still = keyframe.point_ids[bad] == taken.points[taken.bundle.point[of]]
        if still.any():
            slam_map.forget(keyframe, bad[still])
    slam_map.sweep(taken.keyframes)


def parts_of(slam_map: SlamMap) -> Iterator[tuple[list[Keyframe], list[Keyframe], Bools]]:
    """What to `take` one after the other to adjust all; the first two keyframes hold the gauge.

    A long flight is adjusted part by part, each held by the keyframes around it.
    """
    ordered = sorted(slam_map.keyframes.values(), key=lambda k: k.keyframe_id)
    if len(ordered) < 3:
        return
    if len(ordered) <= MOST_TOGETHER:
        yield ordered[2:], ordered[:2], slam_map.alive[: slam_map.n_points].copy()
        return
    for start in range(2, len(ordered), MOST_TOGETHER // 2):
        part = ordered[start : start + MOST_TOGETHER]
        mask = np.zeros(slam_map.n_points, bool)
        for k in part:
            mask[slam_map.seen_by(k)[1]] = True
        inside = {k.keyframe_id for k in part}
        rest = [k for k in ordered if k.keyframe_id not in inside]
        shared = [int(np.count_nonzero(mask[slam_map.seen_by(k)[1]])) for k in rest]
        order = np.argsort(-np.array(shared), kind="stable")[:MOST_HOLDING]
        holding = [rest[int(i)] for i in np.sort(order) if shared[int(i)] >= 3]
        yield part, holding or ordered[:2], mask
