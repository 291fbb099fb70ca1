"""A gimbal that carries a camera: what is known of it beside its angles."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

MAX_AWAY_M, MAX_DELAY_MS, MAX_SIGMA_DEG = 100.0, 500.0, 30.0


@dataclass(frozen=True, slots=True)
class Gimbal:
    """A gimbal between body and camera, whose angles come with telemetry.

    Of a camera on one, `Camera.body_from_camera` is how it sits in the gimbal's head, whose axes
    (FRD) are the body's where all angles are zero.
    """

    place_body_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre of the head's turns from the body's origin, FRD."""
    delay_ms: float = 0.0
    """Delay of the stamps of its angles, where the estimate begins."""
    sigma_deg: float = 1.0
    """One standard deviation of an angle."""

    def document(self) -> dict[str, Any]:
        """As in a calibration file."""
        return {
            "place_body_m": list(self.place_body_m), "delay_ms": self.delay_ms,
            "sigma_deg": self.sigma_deg,
        }  # fmt: skip

    @staticmethod
    def of_document(given: Any) -> Gimbal:
        """Gimbal of such a document; ValueError if invalid."""
        if not isinstance(given, Mapping):
            raise ValueError("gimbal must have the keys place_body_m, delay_ms, sigma_deg, or some")
        unknown = set(given) - {"place_body_m", "delay_ms", "sigma_deg"}
        if unknown:
            raise ValueError(f"gimbal has no key {min(unknown)}")
        place = given.get("place_body_m", [0.0, 0.0, 0.0])
        if not isinstance(place, list) or len(place) != 3:
            raise ValueError("gimbal.place_body_m must be three numbers")
        x, y, z = (_number("place_body_m", v, -MAX_AWAY_M, MAX_AWAY_M) for v in place)
        return Gimbal(
            (x, y, z), _number("delay_ms", given.get("delay_ms", 0.0), -MAX_DELAY_MS, MAX_DELAY_MS),
            _number("sigma_deg", given.get("sigma_deg", 1.0), 0.01, MAX_SIGMA_DEG),
        )  # fmt: skip


def _number(key: str, value: Any, least: float, most: float) -> float:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not is_number or not math.isfinite(value) or not least <= value <= most:
        raise ValueError(f"gimbal.{key} must be from {least:g} to {most:g}, it is {value!r}")
    return float(value)
