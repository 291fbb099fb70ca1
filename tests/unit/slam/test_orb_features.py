"""Corners and descriptors in compiled loops against OpenCV's, and the lens in one."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from companion.config import FeaturesConfig
from companion.geometry.camera import Camera, Distortion
from companion.messages import Bytes
from companion.slam.compiled.shrinking import shrink
from companion.slam.compiled.spreading import spread
from companion.slam.features.orb_features import CELL_PX, FeatureExtractor, features_of, normalise

LENS = Camera(
    640, 480, 500.0, 480.0, 310.0, 245.0, Distortion.RADTAN, (-0.3, 0.1, 2e-3, -1e-3, 0.02)
)


def textured(width: int, height: int) -> Bytes:
    """Blots of all sizes, so that every level has corners."""
    rng = np.random.default_rng(width)
    total = np.zeros((height, width), np.float32)
    for sigma in (1.0, 3.0, 9.0):
        noise = rng.normal(size=(height, width)).astype(np.float32)
        total += cv2.GaussianBlur(noise, (0, 0), sigma) * sigma
    return np.clip(128 + 50 * total, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("size", [(640, 480), (333, 257)])
@pytest.mark.parametrize("scale_factor", [1.2, 1.37])
def test_features_are_those_of_opencv(size: tuple[int, int], scale_factor: float) -> None:
    config = FeaturesConfig(n_features=300, n_levels=6, scale_factor=scale_factor)
    grey, camera = textured(*size), Camera(*size, 500.0, 500.0, size[0] / 2, size[1] / 2)
    found = FeatureExtractor(config, camera).extract(grey)
    orb = cv2.ORB.create(4 * 300, scaleFactor=scale_factor, nlevels=6, fastThreshold=12)
    # of the levels that have too many, OpenCV leaves the strongest in another order
    keypoints = sorted(orb.detect(grey, None), key=lambda k: (k.octave, k.pt[1], k.pt[0]))
    assert len(keypoints) > 1.25 * 300
    pixels = np.array([k.pt for k in keypoints], np.float32)
    response = np.array([k.response for k in keypoints], np.float32)
    chosen = spread(pixels, response, CELL_PX, 300)
    described, words = orb.compute(grey, [keypoints[i] for i in chosen.tolist()])
    octaves = np.array([k.octave for k in described])
    assert len(set(octaves.tolist())) > 3
    half = (0.5 * (scale_factor**octaves - 1.0)).astype(np.float32)
    np.testing.assert_array_equal(found.octaves, octaves)
    np.testing.assert_array_equal(found.pixels, pixels[chosen] + half[:, None])
    np.testing.assert_array_equal(
        found.angles_deg, np.array([k.angle for k in described], np.float32)
    )
    # where a blurred pixel is half way between two grey levels, rounding is not the same
    differ = np.unpackbits(found.descriptors ^ np.asarray(words, np.uint8))
    assert differ.mean() < 1e-4


@pytest.mark.parametrize("size", [(640, 480), (333, 257), (35, 2), (7, 3)])
@pytest.mark.parametrize("scale_factor", [1.2, 1.83])
def test_a_pyramid_is_that_of_opencv(size: tuple[int, int], scale_factor: float) -> None:
    width, height = size
    noise = np.random.default_rng(3).integers(0, 256, (height, width))
    level: Bytes = noise.astype(np.uint8)
    rows, start = [(0, width, height, 0)], width * height
    for k in range(1, 7):
        width, height = round(size[0] / scale_factor**k), round(size[1] / scale_factor**k)
        rows.append((start, width, height, 0))
        start += width * height
    pyramid = np.full(start, 77, np.uint8)
    pyramid[: level.size] = level.ravel()
    shrink(pyramid, np.array(rows))
    for first, width, height, _ in rows[1:]:
        found = pyramid[first : first + width * height].reshape(height, width)
        if 0 < min(width, height):
            shrunk = cv2.resize(level, (width, height), interpolation=cv2.INTER_LINEAR_EXACT)
            level = np.asarray(shrunk, np.uint8)
        expected = level if min(width, height) > 1 else np.zeros_like(found)
        np.testing.assert_array_equal(found, expected)


def test_an_image_without_corners_has_no_features() -> None:
    found = FeatureExtractor(FeaturesConfig(), LENS).extract(np.full((480, 640), 90, np.uint8))
    assert len(found) == 0 and found.descriptors.shape == (0, 32)


def test_pixels_are_undistorted_to_the_same_bytes() -> None:
    pixels = np.random.default_rng(1).uniform(-4000, 4000, (4000, 2)).astype(np.float32)
    pixels[:1000] = np.abs(pixels[:1000]) * [0.16, 0.12]
    expected = LENS.normalise(pixels)
    assert 100 < np.count_nonzero(np.isnan(expected[:, 0])) < 3000  # beyond where the model folds
    assert normalise(LENS, pixels).tobytes() == expected.tobytes()
    assert normalise(LENS, pixels[:0]).shape == (0, 2)


def test_features_are_whitened_to_the_same_bytes() -> None:
    rng = np.random.default_rng(2)
    octaves, normalised = rng.integers(0, 8, 900), rng.uniform(-0.7, 0.7, (900, 2))
    found = features_of(
        LENS, 1.2, np.zeros((900, 2), np.float32), normalised, octaves, np.zeros(900, np.float32),
        np.zeros((900, 32), np.uint8),
    )  # fmt: skip
    sigma = 1.2 ** octaves.astype(np.float64)
    expected = LENS.pixel_from_normalised_jacobian(normalised) / sigma[:, None, None]
    assert found.whitening.tobytes() == expected.tobytes()
