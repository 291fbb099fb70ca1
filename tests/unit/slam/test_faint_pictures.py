"""Faint pictures are strengthened so that corners are found again; others stay as they are."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from companion.config import FeaturesConfig
from companion.geometry.camera import Camera
from companion.messages import Bytes, Floats
from companion.slam.features.faint_pictures import (
    NOISY_SPREAD,
    SPREAD,
    detail_of,
    noise_of,
    strengthened,
)
from companion.slam.features.matching import match_descriptors
from companion.slam.features.orb_features import FeatureExtractor

SHIFT = 37
"""Pixels by which the second picture is taken to the right of the first."""
CAMERA = Camera(400, 300, 350.0, 350.0, 200.0, 150.0)


def ground() -> Floats:
    """Blots of all sizes over more than one picture, with the contrast of daylight."""
    rng = np.random.default_rng(5)
    total = np.zeros((300, 400 + SHIFT), np.float32)
    for sigma in (1.0, 3.0, 9.0):
        noise = rng.normal(size=total.shape).astype(np.float32)
        total += cv2.GaussianBlur(noise, (0, 0), sigma) * sigma
    return np.asarray(25.0 * total / total.std(), np.float32)


def taken(scene: Floats, contrast: float, noise: float, seed: int) -> Bytes:
    rng = np.random.default_rng(seed)
    grey = 90.0 + contrast * scene + rng.normal(scale=max(noise, 1e-9), size=scene.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def n_true_matches(first: Bytes, second: Bytes) -> int:
    a, b = (FeatureExtractor(FeaturesConfig(), CAMERA).extract(each) for each in (first, second))
    ia, ib = match_descriptors(a, b)
    off = a.pixels[ia] - b.pixels[ib] - np.array([SHIFT, 0.0], np.float32)
    return int(np.count_nonzero(np.linalg.norm(off, axis=1) < 3.0))


@pytest.mark.parametrize(("contrast", "noise"), [(0.15, 1.5), (0.1, 1.0)])
def test_more_corners_of_a_faint_ground_are_found_again(contrast: float, noise: float) -> None:
    scene = ground()
    first = taken(scene[:, :400], contrast, noise, 1)
    second = taken(scene[:, SHIFT:], contrast, noise, 2)
    before = n_true_matches(first, second)
    after = n_true_matches(strengthened(first).corners, strengthened(second).corners)
    assert after > max(1.5 * before, 100)


def test_a_faint_picture_gets_the_contrast_of_daylight() -> None:
    out = strengthened(taken(ground()[:, :400], 0.15, 1.5, 1))
    for picture in (out.corners, out.patches):
        assert picture.dtype == np.uint8
        assert picture.std() == pytest.approx(SPREAD, abs=1.0)
        assert picture.mean() == pytest.approx(128.0, abs=2.0)
    assert not out.drowned


def test_a_picture_in_daylight_is_not_touched() -> None:
    picture = taken(ground()[:, :400], 0.5, 2.0, 1)
    assert picture.std() > NOISY_SPREAD
    out = strengthened(picture)
    assert out.corners is picture
    assert out.patches is picture
    assert not out.drowned


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_of_noise_alone_no_contrast_is_made(noise: float) -> None:
    picture = taken(np.zeros((300, 400), np.float32), 0.0, noise, 1)
    assert strengthened(picture).corners.std() < 0.3 * SPREAD
    assert strengthened(picture).drowned
    assert strengthened(picture).nearly_drowned


def test_patches_of_a_noisy_picture_are_aligned_where_corners_were_smoothed() -> None:
    scene = ground()
    grey = taken(scene[:, :400], 0.15, 1.5, 1)
    out = strengthened(grey)
    true = scene[:, :400] / scene.std()
    blurred = cv2.GaussianBlur(true, (0, 0), 2.0)
    corners, patches = (each.astype(np.float32) - 128.0 for each in (out.corners, out.patches))
    assert np.corrcoef(corners.ravel(), blurred.ravel())[0, 1] > 0.9
    assert np.abs(np.diff(patches)).mean() > 1.5 * np.abs(np.diff(corners)).mean()


@pytest.mark.parametrize("noise", [0.5, 1.5, 5.0])
def test_noise_and_detail_are_measured(noise: float) -> None:
    scene = ground()[:, :400]
    seen = np.asarray(cv2.GaussianBlur(scene, (0, 0), 2.0), np.float32)
    grey = taken(seen, 1.0, noise, 3)
    assert noise_of(grey) == pytest.approx(np.hypot(noise, 0.3), rel=0.25)
    shown = detail_of(taken(seen, 1.0, 0.0, 3), 0.3)
    assert detail_of(grey, noise) == pytest.approx(shown, rel=0.1)


def test_the_same_scene_is_the_same_whether_faint_or_just_not() -> None:
    """Pictures on both sides of the bound still match each other."""
    scene = ground()
    first = taken(scene[:, :400], 0.25, 1.5, 1)
    second = taken(scene[:, SHIFT:], 0.3, 1.5, 2)
    assert first.std() < NOISY_SPREAD < second.std()
    n_faint = n_true_matches(strengthened(first).corners, strengthened(first).corners)
    assert n_true_matches(strengthened(first).corners, strengthened(second).corners) > 0.2 * n_faint
