"""Reference implementations of the kernels in numpy."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose, nearest_rotation, rotation_from_vector, skew
from companion.messages import Bytes, Floats
from companion.slam.compiled.pose_kernels import CHI2_2D, HUBER
from companion.slam.features.orb_features import Bools, Features, Ints
from companion.slam.map.sparse_map import SlamMap


def _residuals(
    camera_from_map: Pose, points_map: Array, normalised: Array, whitening: Array
) -> tuple[Array, Array]:
    """Whitened reprojection errors (N, 2) and depths (N,)."""
    p = camera_from_map.apply(points_map)
    z = np.where(np.abs(p[:, 2]) < 1e-9, 1e-9, p[:, 2])
    error = p[:, :2] / z[:, None] - normalised
    return np.einsum("nij,nj->ni", whitening, error), p[:, 2]


def robust_cost(
    camera_from_map: Pose, points_map: Array, normalised: Array, whitening: Array
) -> float:
    """Huber's loss of all N points, those behind the camera at a high constant."""
    r, depth = _residuals(camera_from_map, points_map, normalised, whitening)
    size = np.sqrt((r * r).sum(1))
    loss = np.where(size < HUBER, 0.5 * size * size, HUBER * (size - 0.5 * HUBER))
    return float(np.where(depth > 0, loss, HUBER * 100.0).sum())


def refine_pose(
    camera_from_map: Pose,
    points_map: Array,
    normalised: Array,
    whitening: Array,
    rounds: int = 4,
    iterations: int = 4,
) -> tuple[Pose, Bools, Array]:
    """As `companion.slam.optimisation.pose_refinement.refine_pose`."""
    pose = camera_from_map
    inlier = np.ones(len(points_map), bool)
    information = np.zeros((6, 6))
    for round_ in range(rounds):
        robust = round_ < rounds - 1
        if np.count_nonzero(inlier) < 6:
            break
        pts, obs, white = points_map[inlier], normalised[inlier], whitening[inlier]
        for _ in range(iterations):
            p = pose.apply(pts)
            z = np.where(p[:, 2] > 1e-6, p[:, 2], 1e-6)
            inv = 1.0 / z
            x, y = p[:, 0] * inv, p[:, 1] * inv
            jac = np.zeros((len(pts), 2, 6))
            # derivative of (x/z, y/z) for a left perturbation (rotation, translation)
            jac[:, 0, 0], jac[:, 0, 1], jac[:, 0, 2] = -x * y, 1 + x * x, -y
            jac[:, 1, 0], jac[:, 1, 1], jac[:, 1, 2] = -1 - y * y, x * y, x
            jac[:, 0, 3], jac[:, 0, 5] = inv, -x * inv
            jac[:, 1, 4], jac[:, 1, 5] = inv, -y * inv
            error = np.stack([x, y], 1) - obs
            r = np.matmul(white, error[..., None])[..., 0]
            jac = np.matmul(white, jac)
            size = np.sqrt((r * r).sum(1))
            weight = np.ones(len(size))
            if robust:
                weight = np.minimum(1.0, HUBER / np.maximum(size, 1e-9))
            flat = jac.reshape(-1, 6)
            w2 = np.repeat(weight, 2)
            information = (flat * w2[:, None]).T @ flat
            gradient = flat.T @ (w2 * r.ravel())
            try:
                delta = -np.linalg.solve(information + 1e-9 * np.eye(6), gradient)
            except np.linalg.LinAlgError:
                break
            turn = rotation_from_vector(delta[:3])
            pose = Pose(turn @ pose.rotation, turn @ pose.translation + delta[3:])
            if np.abs(delta).max() < 1e-6:
                break
        r, depth = _residuals(pose, points_map, normalised, whitening)
        inlier = ((r * r).sum(1) < CHI2_2D) & (depth > 0)
    # a pose is refined from one predicted from the last: what rounding adds would grow with each
    return Pose(nearest_rotation(pose.rotation), pose.translation), inlier, information


def visible(
    camera: Camera, slam_map: SlamMap, camera_from_map: Pose, ids: Ints, max_radius: float
) -> tuple[Ints, Array, Ints]:
    """Ids, pixels and levels of the visible points."""
    position = slam_map.positions[ids]
    p = camera_from_map.apply(position)
    towards = (-camera_from_map.rotation.T @ camera_from_map.translation) - position
    distance = np.linalg.norm(towards, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        n = p[:, :2] / p[:, 2:]
        ok = (p[:, 2] > 0) & ((n * n).sum(1) < max_radius**2)
        ok &= (towards * slam_map.normals[ids]).sum(1) > 0.5 * distance
        top = slam_map.base_distance[ids]
        ok &= distance < top * 1.3
        ok &= distance > top / slam_map.scale_factor ** (slam_map.n_levels - 1) * 0.7
    ids, p, distance = ids[ok], p[ok], distance[ok]
    px = camera.project(p)
    inside = ((px >= 0) & (px < [camera.width, camera.height])).all(1)
    ids, px, distance = ids[inside], px[inside], distance[inside]
    level = np.round(np.log(slam_map.base_distance[ids] / distance) / np.log(slam_map.scale_factor))
    return ids, px, np.clip(level, 0, slam_map.n_levels - 1).astype(np.int64)


def match_projected(
    projected_px: Array, descriptors: Bytes, octaves: Ints, features: Features, radius_px: Array,
    max_distance: float = 64, ratio: float = 0.85, max_octave_gap: int = 2,
) -> tuple[Ints, Ints]:  # fmt: skip
    """Indices of mutually best points and features."""
    n, far = len(features), np.float32(1000.0)
    near_px, candidates = cKDTree(features.pixels).query(projected_px, k=min(12, n))
    candidates = candidates.astype(np.int64)
    valid = near_px <= radius_px[:, None]
    valid &= np.abs(features.octaves[candidates] - octaves[:, None]) <= max_octave_gap
    bits = np.unpackbits(descriptors[:, None] ^ features.descriptors[candidates], axis=2)
    distance = bits.sum(2).astype(np.float32)
    distance[~valid] = far
    rows = np.arange(len(projected_px))
    best = distance.argmin(1)
    value = distance[rows, best]
    rival = distance.copy()
    rival[rows, best] = far
    chosen_octave = features.octaves[candidates[rows, best]]
    rival[features.octaves[candidates] != chosen_octave[:, None]] = far
    good = (value <= max_distance) & (value < ratio * rival.min(1))
    points = rows[good]
    taken = candidates[points, best[good]]
    order = np.lexsort((points, value[good]))
    _, first = np.unique(taken[order], return_index=True)
    return points[order[first]], taken[order[first]]


def warps(
    slam_map: SlamMap, camera_from_map: Pose, points: Ints, jacobian: Array, first: Pose
) -> Array:
    """Warps of pixels from the reference view of each point to this view."""
    depth = first.apply(slam_map.positions[points])[:, 2]
    turn = camera_from_map.rotation @ first.rotation.T
    seen = camera_from_map.apply(slam_map.positions[points])
    shift = slam_map.first_unproject[points] * depth[:, None, None]
    in_camera = np.matmul(turn[:, :2], shift)
    n = seen[:, :2] / seen[:, 2:]
    projected = (in_camera[:, :2] - n[:, :, None] * in_camera[:, 2:]) / seen[:, 2:, None]
    return np.asarray(np.matmul(jacobian, projected), np.float64)


def mutual_matches(
    descriptors_a: Bytes, descriptors_b: Bytes, max_distance: float, ratio: float
) -> tuple[Ints, Ints]:
    """As `companion.slam.features.matching.mutual_matches`."""
    words_a, words_b = descriptors_a.view(np.uint64), descriptors_b.view(np.uint64)
    distance = np.bitwise_count(words_a[:, None] ^ words_b[None]).sum(2).astype(np.float32)
    rows = np.arange(len(distance))
    best = distance.argmin(1)
    value = distance[rows, best]
    good = distance.argmin(0)[best] == rows
    distance[rows, best] = np.float32(1000.0)
    good &= (value <= max_distance) & (value < ratio * distance.min(1))
    return rows[good], best[good]


def match_epipolar(
    a: Features, b: Features, index_a: Ints, index_b: Ints, b_from_a: Pose, max_error: float = 2.0
) -> tuple[Ints, Ints]:
    """As `companion.slam.features.matching.match_epipolar`."""
    none = np.zeros(0, np.int64)
    if len(index_a) < 2 or len(index_b) < 2:
        return none, none
    essential = skew(b_from_a.translation) @ b_from_a.rotation
    rays_a = np.c_[a.normalised[index_a], np.ones(len(index_a))]
    rays_b = np.c_[b.normalised[index_b], np.ones(len(index_b))]
    lines = (rays_a @ essential.T).astype(np.float32)
    norm = np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    lines /= np.maximum(norm, 1e-12)
    error = np.abs(lines @ rays_b.T.astype(np.float32))
    sigma = 1.0 / np.sqrt(np.abs(np.linalg.det(b.whitening[index_b])))
    # few pairs lie along the lines: only their descriptors are compared
    near_a, near_b = np.nonzero(error < (max_error * sigma)[None, :].astype(np.float32))
    octaves_a, octaves_b = a.octaves[index_a], b.octaves[index_b]
    alike = np.abs(octaves_a[near_a] - octaves_b[near_b]) <= 4
    near_a, near_b = near_a[alike], near_b[alike]
    words_a = a.descriptors[index_a].view(np.uint64)
    words_b = b.descriptors[index_b].view(np.uint64)
    distance = np.bitwise_count(words_a[near_a] ^ words_b[near_b]).sum(1, dtype=np.int64)
    ia, ib = _mutual_pairs(near_a, near_b, distance, 50, 0.9)
    return index_a[ia], index_b[ib]


def _mutual_pairs(
    ia: Ints, ib: Ints, distance: Ints, max_distance: float, ratio: float
) -> tuple[Ints, Ints]:
    """As `mutual_matches`, over listed pairs."""
    none = np.zeros(0, np.int64)
    if len(ia) == 0:
        return none, none
    by_a = np.lexsort((ib, distance, ia))
    first = np.flatnonzero(np.r_[True, np.diff(ia[by_a]) != 0])
    best = by_a[first]
    following = np.minimum(first + 1, len(by_a) - 1)
    has_rival = (following > first) & (ia[by_a[following]] == ia[best])
    rival = np.where(has_rival, distance[by_a[following]], np.float32(1000.0))
    by_b = np.lexsort((ia, distance, ib))
    best_of_b = np.full(int(ib.max()) + 1, -1)
    starts = np.flatnonzero(np.r_[True, np.diff(ib[by_b]) != 0])
    best_of_b[ib[by_b[starts]]] = by_b[starts]
    good = (distance[best] <= max_distance) & (distance[best] < ratio * rival)
    good &= best_of_b[ib[best]] == best
    return ia[best[good]], ib[best[good]]


def spread(pixels: Floats, response: Floats, cell_px: float, n: int) -> Ints:
    """The strongest of every cell in turn, until there are enough."""
    cells = (pixels.astype(np.float64) // cell_px).astype(np.int64)
    cell = cells[:, 1] * 100_000 + cells[:, 0]
    order = np.lexsort((np.arange(len(cell)), -response, cell))
    starts = np.flatnonzero(np.r_[True, np.diff(cell[order]) != 0])
    sizes = np.diff(np.r_[starts, len(order)])
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order)) - np.repeat(starts, sizes)
    return np.sort(np.lexsort((np.arange(len(cell)), -response, rank))[:n])
