"""Feature matching: by descriptor alone, and along epipolar lines.

Descriptors have 256 bits; distances are Hamming. A match passes a threshold, the ratio test against
the second best, and is mutual.
"""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Pose, skew
from companion.messages import Bytes, Floats
from companion.slam.compiled.searching import search_along
from companion.slam.features.orb_features import Features, Ints

MAX_DISTANCE_STRICT = 50
"""Largest distance, bits, between views of the same corner."""
MAX_OCTAVE_GAP = 4
FAR = np.float32(1000.0)


def hamming_matrix(descriptors_a: Bytes, descriptors_b: Bytes) -> Floats:
    """Distances (Na, Nb) in bits, as float32; by one matrix product of signs."""
    signs_a = np.unpackbits(descriptors_a, axis=1).astype(np.float32) * 2 - 1
    signs_b = np.unpackbits(descriptors_b, axis=1).astype(np.float32) * 2 - 1
    return np.asarray(np.float32(128.0) - np.float32(0.5) * (signs_a @ signs_b.T), np.float32)


def mutual_matches(distances: Floats, max_distance: float, ratio: float) -> tuple[Ints, Ints]:
    """Index pairs that are mutually best; ties resolve to the first."""
    none = np.zeros(0, np.int64)
    if distances.shape[0] == 0 or distances.shape[1] < 2:
        return none, none
    rows = np.arange(distances.shape[0])
    best = distances.argmin(1)
    value = distances[rows, best]
    good = distances.argmin(0)[best] == rows
    second_best = distances.copy()
    second_best[rows, best] = FAR
    good &= (value <= max_distance) & (value < ratio * second_best.min(1))
    return rows[good], best[good]


def match_descriptors(a: Features, b: Features) -> tuple[Ints, Ints]:
    """Match two images by descriptors only."""
    if len(a) == 0 or len(b) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    return mutual_matches(hamming_matrix(a.descriptors, b.descriptors), MAX_DISTANCE_STRICT, 0.8)


def match_epipolar(
    a: Features, b: Features, index_a: Ints, index_b: Ints, b_from_a: Pose, max_error: float = 2.0
) -> tuple[Ints, Ints]:
    """Match features `index_a` of a with `index_b` of b near their epipolar lines.

    `max_error` is in units of a feature's sigma. Returns indices into a and b.
    """
    none = np.zeros(0, np.int64)
    if len(index_a) < 2 or len(index_b) < 2:
        return none, none
    essential = skew(b_from_a.translation) @ b_from_a.rotation
    rays_a = np.c_[a.normalised[index_a], np.ones(len(index_a))]
    rays_b = np.c_[b.normalised[index_b], np.ones(len(index_b))]
    lines = rays_a @ essential.T
    lines /= np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)
    sigma = 1.0 / np.sqrt(np.abs(np.linalg.det(b.whitening[index_b])))
    ia, ib = search_along(
        lines, rays_b, max_error * sigma, a.descriptors[index_a].view(np.uint64),
        b.descriptors[index_b].view(np.uint64), a.octaves[index_a], b.octaves[index_b],
        MAX_OCTAVE_GAP, MAX_DISTANCE_STRICT, 0.9,
    )  # fmt: skip
    return index_a[ia], index_b[ib]
