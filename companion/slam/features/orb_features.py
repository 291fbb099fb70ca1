"""ORB features spread over the image (Rublee et al., ICCV 2011)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from companion.config import FeaturesConfig
from companion.geometry.camera import CONVERGED, Camera, Distortion
from companion.geometry.transforms import Array
from companion.messages import Bytes, Floats
from companion.slam.compiled.compiling import Bools, Ints
from companion.slam.compiled.spreading import spread
from companion.slam.compiled.undistorting import undistort

__all__ = ["Bools", "FeatureExtractor", "Features", "Ints", "features_of", "normalise"]

FAST_THRESHOLD, MIN_FAST_THRESHOLD, MAX_FAST_THRESHOLD = 12, 4, 60
"""Grey levels, initial and least: lower than ORB-SLAM2's 20 and 7, for ground of low contrast. The
largest is for scenes so rich that all corners would take too long."""
CELL_PX = 32
"""Cell size of the grid over which features are distributed; ORB-SLAM2 has 30.
Twice as large changes the error of the sample flight by 1 mm, half as large by 8 of 53."""


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """The N features of one image.

    `pixels` (N, 2) distorted; `normalised` (N, 2) ideal coordinates x/z, y/z; `octaves` (N,)
    pyramid level; `angles_deg` (N,); `descriptors` (N, 32); `sigma_px` (N,) the expected error of a
    position; `whitening` (N, 2, 2) turns an error in normalised coordinates into one in units of
    sigma.
    """

    pixels: Floats
    normalised: Array
    octaves: Ints
    angles_deg: Floats
    descriptors: Bytes
    sigma_px: Array
    whitening: Array

    def __len__(self) -> int:
        return len(self.pixels)


def features_of(
    camera: Camera, scale_factor: float, pixels: Floats, normalised: Array, octaves: Ints,
    angles_deg: Floats, descriptors: Bytes,
) -> Features:  # fmt: skip
    """Features, with sigma and whitening derived; arguments as the fields of `Features`."""
    sigma = scale_factor ** octaves.astype(np.float64)
    whitening = camera.pixel_from_normalised_jacobian(normalised) / sigma[:, None, None]
    return Features(pixels, normalised, octaves, angles_deg, descriptors, sigma, whitening)


def normalise(camera: Camera, pixels: Floats) -> Array:
    """As `Camera.normalise`, in one compiled loop where the lens is radial-tangential."""
    if camera.distortion is not Distortion.RADTAN:
        return camera.normalise(pixels)
    centre, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
    distorted = (pixels.astype(np.float64) - centre) / focal
    return undistort(distorted, np.array(camera.coefficients), CONVERGED)


@dataclass(frozen=True, slots=True, eq=False)
class _Level:
    """A level of the pyramid: pixels of the image by its own, and the extractor on it alone.

    One extractor over all levels builds the pyramid where it detects, and again where it describes.
    """

    scale: np.float32
    orb: cv2.ORB


class FeatureExtractor:
    """Extracts the features of images of one camera."""

    def __init__(self, config: FeaturesConfig, camera: Camera) -> None:
        self._camera = camera
        self._config = config
        self._levels = _levels(config)
        self._threshold = FAST_THRESHOLD
        self.feature_ratio = 1.0
        """Ratio of the configured number of features to extract."""

    @property
    def state(self) -> tuple[int, float]:
        """All that features depend on beside the image: threshold, and ratio of features."""
        return self._threshold, self.feature_ratio

    @state.setter
    def state(self, state: tuple[int, float]) -> None:
        self._threshold, self.feature_ratio = state

    def extract(self, grey: Bytes) -> Features:
        """Features of an image (H, W); possibly none."""
        shrunk = self._pyramid(grey)
        found = self._detect(shrunk)
        pixels = np.concatenate(
            [_pixels(f) * level.scale for f, level in zip(found, self._levels, strict=True)]
        )
        octaves = np.repeat(np.arange(len(found)), [len(f) for f in found])
        chosen = self._spread(pixels, found)
        pixels, octaves = pixels[chosen], octaves[chosen]
        bounds = np.searchsorted(octaves, np.arange(len(found) + 1))
        keypoints = [k for f in found for k in f]
        described = [keypoints[i] for i in chosen.tolist()]
        descriptors = np.zeros((len(chosen), 32), np.uint8)
        for image, level, start, stop in zip(
            shrunk, self._levels, bounds[:-1].tolist(), bounds[1:].tolist(), strict=True
        ):
            if start < stop:
                _, words = level.orb.compute(image, described[start:stop])
                descriptors[start:stop] = words
        angles = np.array([k.angle for k in described], np.float32)
        # levels are shrunk about the image's corner, not about the centre of its first pixel
        half = 0.5 * (self._config.scale_factor**octaves - 1.0)
        pixels += half[:, None].astype(np.float32)
        normalised = normalise(self._camera, pixels)
        seen = np.isfinite(normalised).all(1)
        pixels, octaves, angles = pixels[seen], octaves[seen], angles[seen]
        return features_of(
            self._camera, self._config.scale_factor, pixels, normalised[seen], octaves, angles,
            descriptors[seen],
        )  # fmt: skip

    @property
    def _n_wanted(self) -> int:
        return round(self.feature_ratio * self._config.n_features)

    def _pyramid(self, grey: Bytes) -> list[Bytes]:
        """The image at all levels, each shrunk from the one before."""
        height, width = grey.shape
        shrunk = [grey]
        for level in self._levels[1:]:
            by = np.float32(1.0) / level.scale
            size = round(float(width * by)), round(float(height * by))
            shrunk.append(
                np.asarray(
                    cv2.resize(shrunk[-1], size, interpolation=cv2.INTER_LINEAR_EXACT), np.uint8
                )
            )
        return shrunk

    def _detect(self, shrunk: list[Bytes]) -> list[Sequence[cv2.KeyPoint]]:
        """FAST corners of each level with an adaptive threshold: low contrast has some too."""
        while True:
            found: list[Sequence[cv2.KeyPoint]] = []
            for image, level in zip(shrunk, self._levels, strict=True):
                level.orb.setFastThreshold(self._threshold)
                found.append(level.orb.detect(image, None))
            n = sum(len(f) for f in found)
            if n >= 1.25 * self._n_wanted or self._threshold <= MIN_FAST_THRESHOLD:
                break
            self._threshold = max(MIN_FAST_THRESHOLD, int(self._threshold * 0.7))
        if n > 3 * self._n_wanted:
            self._threshold = min(MAX_FAST_THRESHOLD, self._threshold + 1)
        return found

    def _spread(self, pixels: Floats, found: list[Sequence[cv2.KeyPoint]]) -> Ints:
        response = np.array([k.response for f in found for k in f], np.float32)
        return spread(pixels, response, CELL_PX, self._n_wanted)


def _levels(config: FeaturesConfig) -> list[_Level]:
    """Levels of the pyramid: ORB on one image each, as it divides features over its own levels."""
    factor = float(np.float32(config.scale_factor))
    by = np.float32(1.0 / factor)
    wanted = np.float32(4 * config.n_features) * (1 - by) / (1 - by**config.n_levels)
    left, levels = 4 * config.n_features, []
    for i in range(config.n_levels):
        n = round(float(wanted)) if i < config.n_levels - 1 else max(left, 0)
        orb = cv2.ORB.create(nfeatures=n, nlevels=1)
        levels.append(_Level(np.float32(factor**i), orb))
        left, wanted = left - n, wanted * by
    return levels


def _pixels(keypoints: Sequence[cv2.KeyPoint]) -> Floats:
    return np.array(cv2.KeyPoint.convert(keypoints), np.float32).reshape(-1, 2)
