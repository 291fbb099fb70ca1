"""Feature matching: by descriptor alone, and along epipolar lines.

Descriptors have 256 bits; distances are Hamming. A match passes a threshold, the ratio test against
the second best, and is mutual.
"""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import Pose, skew
from companion.messages import Bytes
from companion.slam.compiled.searching import search_along, search_mutual
from companion.slam.features.orb_features import Features, Ints

MAX_DISTANCE_STRICT = 50
"""Largest distance, bits, between views of the same corner."""
MAX_OCTAVE_GAP = 4


def mutual_matches(
    descriptors_a: Bytes, descriptors_b: Bytes, max_distance: float, ratio: float
) -> tuple[Ints, Ints]:
    """Index pairs that are mutually best, by descriptors alone; ties resolve to the first."""
    if len(descriptors_a) == 0 or len(descriptors_b) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    words_a, words_b = (
        np.ascontiguousarray(each).view(np.uint64) for each in (descriptors_a, descriptors_b)
    )
    return search_mutual(words_a, words_b, max_distance, ratio)


def match_descriptors(a: Features, b: Features) -> tuple[Ints, Ints]:
    """Match two images by descriptors only."""
    return mutual_matches(a.descriptors, b.descriptors, MAX_DISTANCE_STRICT, 0.8)


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
