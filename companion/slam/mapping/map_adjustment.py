"""Bundle adjustment problems extracted from the map, and the write-back of their results.

The map may change in between: what was changed or added meanwhile moves with the adjusted
keyframes, in one step.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from companion.geometry.transforms import Array, Pose
from companion.slam.features.orb_features import Bools, Ints
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.optimisation.bundle_adjustment import AdjustmentResult, Bundle
from companion.slam.optimisation.displacement_factor import DisplacementFactor
from companion.slam.optimisation.factors import Factor
from companion.slam.optimisation.gravity_factor import GravityFactor, gravity_in_map
from companion.slam.optimisation.rotation_factor import relative_rotation_factor

MAX_VARIABLE, MAX_FIXED = 500, 80
"""Keyframes adjusted in one problem, whose memory is quadratic in them, and fixed ones around them.
"""
MAX_COMPARED = 2000
"""Keyframes whose attitudes say where down is in a map: the median of more is no more certain."""
MAX_ROTATION_SPAN_NS = 2_000_000_000
"""Over longer spans integrated gyroscopes are no better than gravity and compass."""


@dataclass(frozen=True, slots=True, eq=False)
class AdjustmentProblem:
    """Keyframes and points of a bundle, with their state at extraction.

    The first `bundle.n_variable` keyframes are variable. `features` (O,) are those of the
    observations; `born` (P,) detects ids recycled since.
    """

    bundle: Bundle
    keyframes: list[Keyframe]
    features: Ints
    points: Ints
    born: Ints


DisplacementSource = Callable[[SlamMap, list[Keyframe]], DisplacementFactor | None]
"""Displacement factor between cameras of a map; None without measurements."""


def no_displacements(slam_map: SlamMap, keyframes: list[Keyframe]) -> None:
    """A source without measurements."""


def build_problem(
    slam_map: SlamMap, variable: list[Keyframe], fixed: list[Keyframe], mask: Bools,
    displacements_of: DisplacementSource = no_displacements,
) -> AdjustmentProblem | None:  # fmt: skip
    """The problem over the points in `mask` (N,) with two observations; None if too few."""
    cameras, obs_cam, obs_feat, obs_id = [*variable, *fixed], [], [], []
    for i, k in enumerate(cameras):
        features, ids = slam_map.observations_of(k)
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
    of = _of_cameras(cam, len(cameras))
    bundle = Bundle(
        [k.camera_from_map for k in cameras], len(variable), slam_map.positions[points],
        cam, index,
        np.concatenate([k.normalised[feat[o]] for k, o in zip(cameras, of, strict=True)]),
        np.concatenate([k.whitening[feat[o]] for k, o in zip(cameras, of, strict=True)]),
        _factors(slam_map, cameras, displacements_of(slam_map, cameras)),
    )  # fmt: skip
    return AdjustmentProblem(bundle, cameras, feat, points, slam_map.born[points])


def _of_cameras(camera: Ints, n: int) -> list[slice]:
    """Observations of each camera, of `camera` (O,) in ascending order."""
    bounds = np.searchsorted(camera, np.arange(n + 1))
    return [slice(a, b) for a, b in pairwise(bounds.tolist())]


def _factors(
    slam_map: SlamMap, cameras: list[Keyframe], displacements: DisplacementFactor | None
) -> list[Factor]:
    """Factors from the autopilot: gravity or else relative rotations, and displacements."""
    everywhere, attitudes = slam_map.spread_keyframes(MAX_COMPARED), _attitudes(cameras)
    rotation = np.stack([k.camera_from_map.rotation for k in everywhere])
    down = gravity_in_map(rotation, _attitudes(everywhere)[:, 2])
    if down is not None:
        measured: Factor | None = GravityFactor(attitudes[:, 2], *down)
    else:
        t_ns = np.array([k.t_ns for k in cameras])
        order = np.argsort(t_ns, kind="stable")
        consecutive = np.diff(t_ns[order]) < MAX_ROTATION_SPAN_NS
        measured = relative_rotation_factor(
            order[:-1][consecutive], order[1:][consecutive], attitudes
        )
    return [factor for factor in (measured, displacements) if factor is not None]


def _attitudes(keyframes: list[Keyframe]) -> Array:
    missing = np.full((3, 3), np.nan)
    return np.stack(
        [missing if k.ned_from_camera is None else k.ned_from_camera for k in keyframes]
    )


def apply_result(slam_map: SlamMap, problem: AdjustmentProblem, result: AdjustmentResult) -> None:
    """Write back a result to an unchanged map."""
    moved = problem.keyframes[: problem.bundle.n_variable]
    for keyframe, pose in zip(moved, result.poses, strict=False):
        keyframe.camera_from_map = pose
    slam_map.keyframes_moved(k.keyframe_id for k in moved)
    slam_map.positions[problem.points] = result.points
    _remove_outliers(slam_map, problem, result)


def apply_result_later(
    slam_map: SlamMap, problem: AdjustmentProblem, result: AdjustmentResult
) -> None:
    """Write back a result to a map that has changed since."""
    before = slam_map.positions[: slam_map.n_points].copy()
    moves = _moves(slam_map, problem, result)
    for key, keyframe in slam_map.keyframes.items():
        keyframe.camera_from_map = keyframe.camera_from_map @ moves[key].inverse()
    slam_map.keyframes_moved()
    same = slam_map.alive[problem.points] & (slam_map.born[problem.points] == problem.born)
    known = problem.points[same]
    slam_map.positions[known] = before[known] + (result.points - problem.bundle.points)[same]
    fresh = slam_map.alive[: slam_map.n_points].copy()
    fresh[known] = False
    ids = np.flatnonzero(fresh)
    homes = slam_map.first_seen[ids]
    for home in np.unique(homes).tolist():
        retired = slam_map.retired.get(home)
        move = moves.get(home if retired is None else retired.anchor_id)
        if move is not None:
            own = ids[homes == home]
            slam_map.positions[own] = move.apply(before[own])
    _remove_outliers(slam_map, problem, result)


def _moves(
    slam_map: SlamMap, problem: AdjustmentProblem, result: AdjustmentResult
) -> dict[int, Pose]:
    """Correction of every keyframe; of a new one that of its most covisible adjusted keyframe."""
    moves = {
        k.keyframe_id: after.inverse() @ before
        for k, before, after in zip(
            problem.keyframes, problem.bundle.poses, result.poses, strict=True
        )
    }
    last = moves[max(moves)]
    for key, keyframe in slam_map.keyframes.items():
        if key in slam_map.held:
            moves[key] = Pose.identity()
        elif key not in moves:
            _, points = slam_map.observations_of(keyframe)
            covisible = (k for _, k in slam_map.covisible(points) if k in moves and k != key)
            moves[key] = moves.get(next(covisible, -1), last)
    return moves


def _remove_outliers(
    slam_map: SlamMap, problem: AdjustmentProblem, result: AdjustmentResult
) -> None:
    wrong = ~result.inlier
    of = _of_cameras(problem.bundle.camera, len(problem.keyframes))
    for keyframe, o in zip(problem.keyframes, of, strict=True):
        bad = problem.features[o][wrong[o]]
        still = keyframe.point_ids[bad] == problem.points[problem.bundle.point[o][wrong[o]]]
        if still.any():
            slam_map.remove_observations(keyframe, bad[still])
    slam_map.clear_dead_observations(problem.keyframes)


def is_without_attitude(slam_map: SlamMap) -> bool:
    """True where no keyframe of a map has an attitude."""
    return not any(k.ned_from_camera is not None for k in slam_map.keyframes.values())


def partition(
    slam_map: SlamMap, bent: Collection[int] | None = None
) -> Iterator[tuple[list[Keyframe], list[Keyframe], Bools]]:
    """Variable keyframes, fixed keyframes and point mask of each problem of a global adjustment.

    The first two keyframes are held, or those of an earlier flight; the first alone where no
    attitude is known (`Mapper.adjust_locally`). A long flight is adjusted in overlapping windows,
    each held by covisible keyframes; where the keyframes `bent` are given, only those windows that
    have one.
    """
    ordered = sorted(slam_map.keyframes.values(), key=lambda k: k.keyframe_id)
    n_held = 1 if is_without_attitude(slam_map) else 2
    held = [k for k in ordered if k.keyframe_id in slam_map.held] or ordered[:n_held]
    free = [k for k in ordered[n_held:] if k.keyframe_id not in slam_map.held]
    if not free:
        return
    if len(ordered) <= MAX_VARIABLE:
        yield free, held, slam_map.alive[: slam_map.n_points].copy()
        return
    for start in range(0, len(free), MAX_VARIABLE // 2):
        part = free[start : start + MAX_VARIABLE]
        if bent is not None and not any(k.keyframe_id in bent for k in part):
            continue
        mask = np.zeros(slam_map.n_points, bool)
        for k in part:
            mask[slam_map.observations_of(k)[1]] = True
        inside = {k.keyframe_id for k in part}
        rest = [k for k in ordered if k.keyframe_id not in inside]
        shared = [int(np.count_nonzero(mask[slam_map.observations_of(k)[1]])) for k in rest]
        order = np.argsort(-np.array(shared), kind="stable")[:MAX_FIXED]
        holding = [rest[int(i)] for i in np.sort(order) if shared[int(i)] >= 3]
        yield part, holding or held[:2], mask
