"""ORB features spread over the image (Rublee et al., ICCV 2011)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.config import FeaturesConfig
from companion.geometry.camera import CONVERGED, Camera, Distortion
from companion.geometry.transforms import Array
from companion.messages import Bytes, Floats
from companion.slam.compiled.compiling import Bools, Ints
from companion.slam.compiled.corners import corners
from companion.slam.compiled.describing import described
from companion.slam.compiled.shrinking import shrink
from companion.slam.compiled.spreading import spread
from companion.slam.compiled.undistorting import undistort, whiten

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
    return Features(
        pixels, normalised, octaves, angles_deg, descriptors, sigma,
        _whitening(camera, normalised, sigma),
    )  # fmt: skip


def _whitening(camera: Camera, normalised: Array, sigma_px: Array) -> Array:
    if camera.distortion is not Distortion.RADTAN:
        return camera.pixel_from_normalised_jacobian(normalised) / sigma_px[:, None, None]
    focal = np.array([camera.fx, camera.fy])
    return whiten(normalised, np.array(camera.coefficients), focal, sigma_px)


def normalise(camera: Camera, pixels: Floats) -> Array:
    """As `Camera.normalise`, in one compiled loop where the lens is radial-tangential."""
    if camera.distortion is not Distortion.RADTAN:
        return camera.normalise(pixels)
    centre, focal = np.array([camera.cx, camera.cy]), np.array([camera.fx, camera.fy])
    distorted = (pixels.astype(np.float64) - centre) / focal
    return undistort(distorted, np.array(camera.coefficients), CONVERGED)


class FeatureExtractor:
    """Extracts the features of images of one camera."""

    def __init__(self, config: FeaturesConfig, camera: Camera) -> None:
        self._camera = camera
        self._config = config
        factor = float(np.float32(config.scale_factor))
        self._scales = np.array([factor**i for i in range(config.n_levels)], np.float32)
        self._levels, self._pyramid = np.zeros((1, 4), np.int64), np.zeros(0, np.uint8)
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
        self._shrink(grey)
        at, octaves, pixels, response = self._detect()
        chosen = spread(pixels, response, CELL_PX, self._n_wanted)
        octaves, pixels = octaves[chosen], pixels[chosen]
        angles, descriptors = described(self._pyramid, self._levels, octaves, at[chosen])
        # levels are shrunk about the image's corner, not about the centre of its first pixel
        half = 0.5 * (self._config.scale_factor**octaves - 1.0)
        pixels += half[:, None].astype(np.float32)
        normalised = normalise(self._camera, pixels)
        seen = np.isfinite(normalised).all(1)
        if not seen.all():
            pixels, normalised, octaves = pixels[seen], normalised[seen], octaves[seen]
            angles, descriptors = angles[seen], descriptors[seen]
        return features_of(
            self._camera, self._config.scale_factor, pixels, normalised, octaves, angles,
            descriptors,
        )  # fmt: skip

    @property
    def _n_wanted(self) -> int:
        return round(self.feature_ratio * self._config.n_features)

    def _shrink(self, grey: Bytes) -> None:
        """Fill the pyramid by the image at all levels, each shrunk from the one before."""
        if grey.shape != (self._levels[0, 2], self._levels[0, 1]):
            self._levels = _levels(grey.shape, self._scales, 4 * self._config.n_features)
            self._pyramid = np.empty(self._levels[:, 1:3].prod(1).sum(), np.uint8)
        self._pyramid[: grey.size].reshape(grey.shape)[:] = grey
        shrink(self._pyramid, self._levels)

    def _detect(self) -> tuple[Ints, Ints, Floats, Floats]:
        """FAST corners with an adaptive threshold: low contrast has some too; as of `corners`."""
        while True:
            found = corners(self._pyramid, self._levels, self._scales, self._threshold)
            n = len(found[0])
            if n >= 1.25 * self._n_wanted or self._threshold <= MIN_FAST_THRESHOLD:
                break
            self._threshold = max(MIN_FAST_THRESHOLD, int(self._threshold * 0.7))
        if n > 3 * self._n_wanted:
            self._threshold = min(MAX_FAST_THRESHOLD, self._threshold + 1)
        return found


def _levels(shape: tuple[int, ...], scales: Floats, n_features: int) -> Ints:
    """Levels (L, 4) of a pyramid as of `corners`, with corners in proportion to their sides."""
    by = np.float32(1.0) / scales
    whole = np.array(shape[::-1], np.float32)
    sizes = np.rint(whole * by[:, None]).astype(np.int64)
    starts = np.append(0, np.cumsum(sizes.prod(1))[:-1])
    return np.column_stack([starts, sizes, np.rint(n_features * by / by.sum())]).astype(np.int64)
