"""Patch alignment: sub-pixel accuracy, or a detected failure."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from companion.geometry.transforms import Array
from companion.messages import Bytes
from companion.slam.features.orb_features import Bools
from companion.slam.features.patches import align, cut, image_levels
from tests.support.reference import numpy_patch_alignment

CENTRE = np.array([160.0, 120.0])
N = 120


def picture(rng: np.random.Generator) -> Bytes:
    noise = rng.normal(size=(240, 320)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5) + cv2.GaussianBlur(noise, (0, 0), 4.0) * 2
    share = (smooth - smooth.min()) / np.ptp(smooth)
    return np.asarray(10 + 235 * share, np.uint8)


def find(warp: Array, level: int, off_px: float, gain: float = 1.0) -> tuple[Array, Bools]:
    """Distances of aligned positions from the true ones, and the mask of success."""
    rng = np.random.default_rng(level)
    first = picture(rng)
    shift = CENTRE - warp @ CENTRE + [5.3, -4.6]
    moved = cv2.warpAffine(first, np.c_[warp, shift], (320, 240), flags=cv2.INTER_CUBIC)
    moved = np.clip(moved * gain, 0, 255).astype(np.uint8)
    pixels = rng.uniform([130, 100], [190, 140], (N, 2))
    patches = cut(image_levels(first), pixels, np.full(N, level))
    truth = pixels @ warp.T + shift
    start = truth + rng.uniform(-off_px, off_px, truth.shape)
    warps = np.repeat(warp[None], N, 0)
    found, sure = align(patches, warps, image_levels(moved), start, np.full(N, 6.0))
    return np.linalg.norm(found - truth, axis=1), sure


def turn(angle: float, scale: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return scale * np.array([[c, -s], [s, c]])


@pytest.mark.parametrize(("level", "within_px"), [(0, 0.1), (1, 0.15)])
@pytest.mark.parametrize("angle", [0.0, 0.5, 3.0])
def test_moved_rotated_and_darkened_patch_is_aligned(
    level: int, within_px: float, angle: float
) -> None:
    error, sure = find(turn(angle, 1.1), level, 0.7, gain=0.8)
    assert sure.mean() > 0.6
    assert np.median(error[sure]) < within_px


def test_patch_at_twice_the_size_is_aligned_one_level_up() -> None:
    error, sure = find(turn(0.2, 1.9), 0, 0.7)
    assert sure.mean() > 0.7
    assert np.median(error[sure]) < 0.15


def test_absent_patch_is_not_aligned() -> None:
    rng = np.random.default_rng(1)
    first, other = picture(rng), picture(rng)
    pixels = rng.uniform([60, 60], [260, 180], (N, 2))
    patches = cut(image_levels(first), pixels, np.zeros(N, np.int64))
    warps = np.repeat(np.eye(2)[None], N, 0)
    _, sure = align(patches, warps, image_levels(other), pixels, np.full(N, 6.0))
    assert sure.mean() < 0.1


def test_untextured_and_border_patches_are_unchanged() -> None:
    blank = np.full((240, 320), 99, np.uint8)
    pixels = np.array([[160.0, 120.0], [2.0, 2.0]])
    patches = cut(image_levels(blank), pixels, np.zeros(2, np.int64))
    assert patches.level.tolist() == [0, -1]
    warps = np.repeat(np.eye(2)[None], 2, 0)
    found, sure = align(patches, warps, image_levels(blank), pixels, np.full(2, 6.0))
    assert not sure.any()
    assert np.array_equal(found, pixels)


def test_alignment_matches_numpy() -> None:
    rng = np.random.default_rng(8)
    first = picture(rng)
    turned = cv2.warpAffine(first, np.array([[1.05, 0.1, -20.0], [-0.05, 0.9, 15.0]]), (320, 240))
    moved = np.asarray(turned, np.uint8)
    pixels = rng.uniform([20, 20], [300, 220], (300, 2))
    patches = cut(image_levels(first), pixels, rng.integers(0, 3, 300))
    warps = np.array([[1.05, 0.1], [-0.05, 0.9]]) * rng.choice([0.4, 1.0, 1.0, 2.0], (300, 1, 1))
    warps[:5] = (
        [[0.0, 0.0], [0.0, 0.0]],
        [[np.nan, 0.0], [0.0, 1.0]],
        [[1, 1], [1, 1]],
        [[9, 0], [0, 9]],
        [[-1, 0], [0, 1]],
    )
    start = pixels @ np.array([[1.05, 0.1], [-0.05, 0.9]]).T + [-20.0, 15.0]
    start += rng.normal(scale=0.7, size=start.shape)
    found, sure = align(patches, warps, image_levels(moved), start, np.full(300, 2.0))
    there, certain = numpy_patch_alignment.align(
        patches, warps, image_levels(moved), start, np.full(300, 2.0)
    )
    assert not sure[:4].any()
    assert np.mean(sure == certain) > 0.98
    both = sure & certain
    assert both.sum() > 100
    assert np.abs(found - there)[both].max() < 0.05
    assert np.array_equal(found[~sure], start[~sure])


def test_no_patches() -> None:
    levels = image_levels(np.zeros((48, 64), np.uint8))
    patches = cut(levels, np.zeros((0, 2)), np.zeros(0, np.int64))
    found, sure = align(patches, np.zeros((0, 2, 2)), levels, np.zeros((0, 2)), np.zeros(0))
    assert found.shape == (0, 2) and sure.shape == (0,)
