"""ORB features spread over the image (Rublee et al., ICCV 2011)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from companion.config import FeaturesConfig
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array
from companion.messages import Bytes, Floats
from companion.slam.compiled.compiling import Bools, Ints
from companion.slam.compiled.spreading import spread

__all__ = ["Bools", "FeatureExtractor", "Features", "Ints", "features_of"]

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


class FeatureExtractor:
    """Extracts the features of images of one camera."""

    def __init__(self, config: FeaturesConfig, camera: Camera) -> None:
        self._camera = camera
        self._config = config
        self._orb = cv2.ORB.create(
            nfeatures=4 * config.n_features,
            scaleFactor=config.scale_factor,
            nlevels=config.n_levels,
            fastThreshold=FAST_THRESHOLD,
        )
        self._threshold = FAST_THRESHOLD
        self.feature_ratio = 1.0
        """Ratio of the configured number of features to extract."""

    def extract(self, grey: Bytes) -> Features:
        """Features of an image (H, W); possibly none."""
        keypoints = self._detect(grey)
        words = None
        if keypoints:
            chosen = [keypoints[i] for i in self._spread(keypoints)]
            described, words = self._orb.compute(grey, chosen)
            keypoints = list(described)
        descriptors = np.zeros((0, 32), np.uint8) if words is None else np.asarray(words, np.uint8)
        pixels = _pixels(keypoints)
        octaves = np.array([k.octave for k in keypoints], np.int64)
        angles = np.array([k.angle for k in keypoints], np.float32)
        # levels are shrunk about the image's corner, not about the centre of its first pixel
        half = 0.5 * (self._config.scale_factor**octaves - 1.0)
        pixels += half[:, None].astype(np.float32)
        normalised = self._camera.normalise(pixels)
        seen = np.isfinite(normalised).all(1)
        pixels, octaves, angles = pixels[seen], octaves[seen], angles[seen]
        return features_of(
            self._camera, self._config.scale_factor, pixels, normalised[seen], octaves, angles,
            descriptors[seen],
        )  # fmt: skip

    @property
    def _n_wanted(self) -> int:
        return round(self.feature_ratio * self._config.n_features)

    def _detect(self, grey: Bytes) -> list[cv2.KeyPoint]:
        """FAST corners with an adaptive threshold, so that low-contrast ground has some too."""
        while True:
            self._orb.setFastThreshold(self._threshold)
            keypoints = list(self._orb.detect(grey, None))
            if len(keypoints) >= 1.25 * self._n_wanted or self._threshold <= MIN_FAST_THRESHOLD:
                break
            self._threshold = max(MIN_FAST_THRESHOLD, int(self._threshold * 0.7))
        if len(keypoints) > 3 * self._n_wanted:
            self._threshold = min(MAX_FAST_THRESHOLD, self._threshold + 1)
        return keypoints

    def _spread(self, keypoints: list[cv2.KeyPoint]) -> list[int]:
        response = np.array([k.response for k in keypoints], np.float32)
        chosen: list[int] = spread(_pixels(keypoints), response, CELL_PX, self._n_wanted).tolist()
        return chosen


def _pixels(keypoints: list[cv2.KeyPoint]) -> Floats:
    return np.array(cv2.KeyPoint.convert(keypoints), np.float32).reshape(-1, 2)
