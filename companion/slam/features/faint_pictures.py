"""Strengthening of faint pictures, in which noise drowns what the scene shows.

At dusk and in haze the differences of the scene are a few grey levels: less than the thresholds of
corners and patches, and rounded away where pictures are smoothed in whole grey levels. Detail of
the sizes that survive the noise is cut out by a difference of Gaussians (Marr & Hildreth 1980), in
floating point, and spread over the range of grey levels.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from companion.messages import Bytes, Floats

FAINT_SPREAD = 6.0
"""Standard deviation of a picture, grey levels, below which it is faint: half of the least that is
usual in daylight, and a quarter of the common."""
NOISY_SPREAD, NOISY_RATIO = 7.0, 4.0
"""So it is below this one where its detail is less than so many times its noise."""
SMOOTHING_PX = 2.8
"""Standard deviation of the smoothing of corners where detail and noise are alike. The detail of a
scene falls with the frequency and noise does not: they meet at a wave as long as their ratio is
small. In pictures of known motion most corners are found again between 2.2 and 3.8."""
LEAST_SMOOTHING_PX, MOST_SMOOTHING_PX = 0.5, 2.5
"""Smallest, of patches always: alignment sums over a patch, and only its rounding asks for some.
What is smoothed by more than the largest has too few corners left."""
BROAD_PX = 25.0
"""Of what is taken away: shades wider than this would use up the range."""
SHRINK = 8
"""The broad part is made of a picture smaller by this."""
SPREAD = 20.0
"""Standard deviation of what comes out, grey levels: about that of a picture in daylight, and far
enough from black and white that next to nothing is cut off."""
MAX_GAIN = 30.0
"""Reached where the detail is two thirds of a grey level, of which a camera's noise (1.5 grey
levels leave 0.2) is a third; from there on down what comes out fades as the picture does. A sudden
end would leave the map without its corners from one frame to the next."""

DROWNED_RATIO = 0.5
"""Detail over noise below which a picture is drowned: corners are found again, but for the most
part where the noise has put them, and a map of such points wanders by a quarter of the way."""
LEAST_SPREAD = 0.75 * SPREAD
"""Standard deviation of what comes out where the detail is half a grey level."""

BLOCK_PX, FLAT_SHARE, CUT_OFF = 16, 0.2, 4
"""Noise is that of the flattest share of such blocks, of those further from black and white than
this."""
PROBE_SHRINK = 4
"""Detail is measured in a picture smaller by this, of whose pixels each is a mean of sixteen."""


@dataclass(frozen=True, slots=True, eq=False)
class Strengthened:
    """A picture (H, W) as corners are to be found in it, and as patches of it are to be aligned.

    In daylight both are the picture itself.
    """

    corners: Bytes
    patches: Bytes
    detail_ratio: float = float("inf")
    """Detail over noise, where it was measured."""

    @property
    def drowned(self) -> bool:
        """True if what is found is noise for the most part."""
        return self.detail_ratio <= DROWNED_RATIO

    @property
    def nearly_drowned(self) -> bool:
        """True if there is no more detail than noise, or hardly any at all."""
        faint = self.corners is not self.patches
        return self.detail_ratio <= 2.0 * DROWNED_RATIO or (
            faint and float(cv2.meanStdDev(self.corners)[1][0, 0]) < LEAST_SPREAD
        )


def strengthened(grey: Bytes) -> Strengthened:
    """Picture (H, W) with the contrast of daylight where it is faint; else `grey` itself."""
    spread = float(cv2.meanStdDev(grey)[1][0, 0])
    if spread >= NOISY_SPREAD:
        return Strengthened(grey, grey)
    noise = noise_of(grey)
    detail = detail_of(grey, noise)
    if spread >= FAINT_SPREAD and detail >= NOISY_RATIO * noise:
        return Strengthened(grey, grey)
    height, width = grey.shape
    small = (max(1, width // SHRINK), max(1, height // SHRINK))
    exact = grey.astype(np.float32)
    broad = cv2.GaussianBlur(
        cv2.resize(exact, small, interpolation=cv2.INTER_AREA), (0, 0), BROAD_PX / SHRINK
    )
    broad = cv2.resize(broad, (width, height), interpolation=cv2.INTER_LINEAR)
    fine_px = min(
        max(SMOOTHING_PX * noise / max(detail, 1e-6), LEAST_SMOOTHING_PX), MOST_SMOOTHING_PX
    )
    return Strengthened(
        _spread_out(cv2.GaussianBlur(exact, (0, 0), fine_px) - broad),
        _spread_out(cv2.GaussianBlur(exact, (0, 0), LEAST_SMOOTHING_PX) - broad),
        detail / max(noise, 1e-6),
    )


def noise_of(grey: Bytes) -> float:
    """Standard deviation of the noise of a picture (H, W), grey levels (Immerkaer 1996).

    Second differences across and down, of which edges leave little, are averaged over blocks; the
    scene adds least to the flattest. Blocks that are black or white have no noise to measure.
    """
    across = np.array([1.0, -2.0, 1.0], np.float32)
    rough = np.abs(cv2.sepFilter2D(grey, cv2.CV_32F, across, across))
    height, width = grey.shape
    blocks = max(1, width // BLOCK_PX), max(1, height // BLOCK_PX)
    means = cv2.resize(rough, blocks, interpolation=cv2.INTER_AREA)
    level = cv2.resize(grey, blocks, interpolation=cv2.INTER_AREA)
    grown = means[(level > CUT_OFF) & (level < 255 - CUT_OFF)]
    if len(grown) == 0:
        return 0.0
    # 6: root of the sum of squared weights; the mean of absolute values to a standard deviation
    return float(np.quantile(grown, FLAT_SHARE)) / 6.0 * float(np.sqrt(np.pi / 2.0))


def detail_of(grey: Bytes, noise: float) -> float:
    """Standard deviation, grey levels, of what a picture (H, W) shows beside shades and noise."""
    height, width = grey.shape
    small = max(1, width // PROBE_SHRINK), max(1, height // PROBE_SHRINK)
    probe = cv2.resize(grey.astype(np.float32), small, interpolation=cv2.INTER_AREA)
    shown = probe - cv2.GaussianBlur(probe, (0, 0), BROAD_PX / PROBE_SHRINK)
    return float(np.sqrt(max(float(shown.var()) - (noise / PROBE_SHRINK) ** 2, 0.0)))


def _spread_out(detail: Floats) -> Bytes:
    gain = min(SPREAD / max(float(detail.std()), 1e-6), MAX_GAIN)
    return np.asarray(np.clip(np.rint(gain * detail + 128.0), 0, 255), np.uint8)
