"""Looks of the drawn scene: ground, light, and what the sensor makes of it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Look:
    """Appearance of ground and light. A strength is 1 for a texture as it is, 0 for its mean."""

    ground: float = 1.0
    """Strength of the whole ground's texture."""
    stones: float = 1.0
    """Of what is seen from some metres."""
    grain: float = 1.0
    """Of what is seen from some decimetres."""
    mean: tuple[float, float, float] = (0.44, 0.41, 0.31)
    """RGB that a weak texture goes towards."""
    drift_m_s: float = 0.0
    """Speed of stones and grain, against each other: waves."""
    light: float = 1.3
    """Brightness; the textures are those of an overcast sky."""
    noise: float = 2.0
    """Deviation of the sensor's noise, grey levels of 255."""
    exposure_s: float = 0.0
    """Time over which motion blurs; shorter than 2 ms blurs nothing that could be seen."""
    shadow: bool = False
    """The vehicle throws a shadow."""


LOOKS = {
    "day": Look(),
    # gain makes up for most of the light, and noise comes with it
    "dusk": Look(light=0.5, noise=8.0, exposure_s=0.02),
    "lawn": Look(ground=0.08, stones=0.12, grain=0.35, mean=(0.34, 0.45, 0.22)),
    "water": Look(ground=0.04, stones=0.25, grain=0.3, mean=(0.30, 0.38, 0.42), drift_m_s=0.4),
    "shadow": Look(shadow=True),
}
