"""Exposure and gain chosen for tracking: short enough not to blur, the rest of the light by gain.

A blurred corner is lost, a noisy one is not. The exposure is therefore bounded so that nothing
moves by more than 1.5 pixels in it; within that bound it is as long as the light allows, as gain
adds noise. Where it ends, gain does the rest. What a step of gain is worth differs from camera to
camera (decibels, factors, sixteenths), so that its steps grow smaller with each change of sign.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from companion.messages import Bytes

MAX_BLUR_PX = 1.5
MEAN, BAND = 105.0, 1.25
"""Mean grey level that is aimed at, and the ratio by which it may be off: dimmer than the middle,
so that what is bright keeps its corners."""
WHITE, MOST_WHITE = 250, 0.03
"""Grey level that is taken for overexposed, and the largest share of such pixels."""
LESS_OF_WHITE = 0.8
MAX_RATIO = 2.0
"""Largest change of the light at once."""
SETTLED_FRAMES = 6
"""Frames between changes: drivers take two to four until a setting is seen in a picture."""
HELD_S = 1.0
"""Time in which the memory of a fast motion fades to a third: a vehicle that turns turns again."""
MAX_FRAME_SHARE = 0.9
"""Of the time between frames, the longest exposure: the sensor must be read out, too."""
GAIN_SHARE, LEAST_GAIN_SHARE, MOST_GAIN_SHARE = 1 / 16, 1 / 1024, 1 / 8
"""Change of gain for twice or half the light, as a share of its range: at first, least and most."""
REVERSED, REPEATED = 0.5, 1.25
"""Ratios by which that changes with the sign, and without: three changes one way and one back still
make it smaller."""
LENGTHENED, SHORT_SHARE = 1.2, 0.5
"""Ratio by which the exposure grows at once where gain can be saved for it, and the share of the
longest one under which it does: a single step of gain may double the light."""


@dataclass(frozen=True, slots=True)
class Exposure:
    """Exposure time, and gain in the camera's own steps, None where it has none to set."""

    exposure_us: int
    gain: int | None


@dataclass(frozen=True, slots=True)
class ExposureRange:
    """Limits of what a camera can be set to, both ends included."""

    exposure_us: tuple[int, int]
    gain: tuple[int, int] | None


class ExposureChoice:
    """Pictures and the speed of the image in, settings out."""

    def __init__(self, able: ExposureRange, now: Exposure, rate_hz: float) -> None:
        self.now = now
        self._able = able
        self._settle_ns = round(SETTLED_FRAMES * 1e9 / rate_hz)
        self._frame_us = 1e6 / rate_hz
        self._changed_ns: int | None = None
        self._fast_px_s = 0.0
        self._last_ns: int | None = None
        self._gain_share = GAIN_SHARE
        self._gain_sign = 0.0

    def longest_us(self) -> int:
        """The longest exposure for the present motion, within what the camera can."""
        least, most = self._able.exposure_us
        by_motion = 1e6 * MAX_BLUR_PX / max(self._fast_px_s, 1e-3)
        return max(least, math.floor(min(most, MAX_FRAME_SHARE * self._frame_us, by_motion)))

    def step(self, t_ns: int, grey: Bytes, image_px_s: float) -> Exposure | None:
        """The next setting after a picture (H, W) taken at `t_ns`; None: leave it as it is.

        `image_px_s` is the speed at which the fastest of the picture moves, px/s.
        """
        if self._last_ns is not None:
            self._fast_px_s *= math.exp(-max(t_ns - self._last_ns, 0) * 1e-9 / HELD_S)
        self._fast_px_s = max(self._fast_px_s, image_px_s)
        self._last_ns = t_ns
        longest_us = self.longest_us()
        wanted = self.now
        if wanted.exposure_us > longest_us:
            wanted = replace(wanted, exposure_us=longest_us)
        elif self._changed_ns is None or t_ns - self._changed_ns >= self._settle_ns:
            wanted = self._for_light(_missing_light(grey), longest_us)
        if wanted == self.now:
            return None
        self.now, self._changed_ns = wanted, t_ns
        return wanted

    def _for_light(self, ratio: float, longest_us: int) -> Exposure:
        """Setting by which the picture gets `ratio` times the light, or nearer to it."""
        now, gain = self.now, self._able.gain
        least_gain = gain[0] if gain is not None else None
        if 1 / BAND < ratio < BAND:
            if now.gain == least_gain or now.exposure_us >= SHORT_SHARE * longest_us:
                return now
            longer_us = math.ceil(LENGTHENED * now.exposure_us)
            return replace(self._with_gain(1 / LENGTHENED), exposure_us=longer_us)
        if ratio > 1:
            by_time = now.exposure_us < longest_us
        else:  # where gain has just been raised, its step was too large
            by_time = now.gain == least_gain or self._gain_sign > 0
            self._gain_sign = min(self._gain_sign, 0.0)
        if by_time:
            least_us = self._able.exposure_us[0]
            us = min(max(round(ratio * now.exposure_us), least_us), longest_us)
            return replace(now, exposure_us=us)
        return self._with_gain(ratio)

    def _with_gain(self, ratio: float) -> Exposure:
        gain, now = self._able.gain, self.now.gain
        if gain is None or now is None:
            return self.now
        sign = math.copysign(1.0, ratio - 1.0)
        grown = {-1.0: REVERSED, 1.0: REPEATED}.get(sign * self._gain_sign, 1.0)
        self._gain_share = min(max(grown * self._gain_share, LEAST_GAIN_SHARE), MOST_GAIN_SHARE)
        self._gain_sign = sign
        by = math.ceil(self._gain_share * (gain[1] - gain[0]) * abs(math.log2(ratio)))
        return replace(self.now, gain=min(max(now + int(sign) * by, gain[0]), gain[1]))


def _missing_light(grey: Bytes) -> float:
    """Ratio of the light that a picture should have had to what it had, 1/2 to 2."""
    ratio = MEAN / max(float(cv2.mean(grey)[0]), 1.0)
    if np.count_nonzero(grey >= WHITE) > MOST_WHITE * grey.size:
        ratio = min(ratio, LESS_OF_WHITE / BAND)
    return min(max(ratio, 1 / MAX_RATIO), MAX_RATIO)
