"""Configuration keys that a ground station can read and set as parameters.

As in MAVLink every value is a float: true is 1, an enumerated word is its index.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from companion.config import Config
from companion.config.setting_keys import value_of_key, words_of
from companion.errors import ConfigError

DIGITS = 7
"""Precision of a 32-bit float."""


@dataclass(frozen=True, slots=True)
class FlightParameter:
    """A configuration key under a name of at most 16 characters."""

    name: str
    full_key: str
    at_once: bool = False
    """True if a change takes effect at once; else it does with the next map."""


def _table() -> dict[str, FlightParameter]:
    found = (
        FlightParameter("FB_MODE", "feedback.mode", at_once=True),
        FlightParameter("FB_FLOW", "feedback.flow", at_once=True),
        FlightParameter("FB_RATE_HZ", "expert.feedback.rate_hz", at_once=True),
        FlightParameter("FB_MAX_SIGMA_M", "expert.feedback.max_sigma_m", at_once=True),
        FlightParameter("FB_MIN_QUALITY", "expert.feedback.min_quality", at_once=True),
        FlightParameter("FB_MAX_GAP_MS", "expert.feedback.max_gap_ms", at_once=True),
        FlightParameter("FB_RESUME_S", "expert.feedback.resume_after_s", at_once=True),
        FlightParameter("FB_MAX_JUMP_M", "expert.feedback.max_jump_m"),
        FlightParameter("MAP_DENSE", "depth.enabled", at_once=True),
        FlightParameter("MAP_STRIDE", "expert.depth.stride"),
        FlightParameter("MAP_MIN_ZNCC", "expert.depth.min_zncc"),
        FlightParameter("MAP_MIN_INLIERS", "expert.depth.min_inlier_ratio"),
        FlightParameter("MAP_SIGMA", "expert.depth.converged_sigma"),
        FlightParameter("MAP_VOXEL_M", "cloud.voxel_m"),
        FlightParameter("MAP_AGREEING", "expert.cloud.min_agreeing"),
        FlightParameter("MAP_AGREEMENT", "expert.cloud.agreement"),
        FlightParameter("TRK_MIN_INLIERS", "expert.tracking.min_inliers"),
        FlightParameter("TRK_RESTART_S", "expert.tracking.restart_after_s"),
        FlightParameter("TRK_FEATURES", "expert.features.n_features"),
        FlightParameter("GEO_MIN_TRAVEL_M", "expert.georeference.min_travel_m"),
        FlightParameter("GEO_MAX_SIGMA", "expert.georeference.max_sigma_scale"),
        FlightParameter("STR_KBIT_S", "expert.stream.budget_kbit_s", at_once=True),
        FlightParameter("VIEW_JPEG", "expert.viewer.jpeg_quality"),
        FlightParameter("REC_ENABLED", "recorder.enabled"),
        FlightParameter("REC_CLOUD", "expert.recorder.point_cloud"),
        FlightParameter("REC_JPEG", "expert.recorder.jpeg_quality"),
        FlightParameter("REC_LEAST_MB", "expert.recorder.least_free_mb"),
        FlightParameter("DMN_HOT_C", "expert.daemon.hot_c", at_once=True),
        FlightParameter("DMN_STATUS_S", "expert.daemon.status_every_s", at_once=True),
    )
    return {parameter.name: parameter for parameter in found}


PARAMETERS = _table()


def number_of(config: Config, parameter: FlightParameter) -> float:
    """Parameter value of a key's value."""
    value: Any = value_of_key(config, parameter.full_key)
    if isinstance(value, str):
        return float(words_of(parameter.full_key).index(value))
    return float(value)


def value_of(config: Config, parameter: FlightParameter, number: float) -> Any:
    """Key's value of a parameter value; ConfigError for a wrong type.

    The range is not checked here.
    """
    now: Any = value_of_key(config, parameter.full_key)
    wants = ""
    if not math.isfinite(number):
        wants = "a finite number"
    elif isinstance(now, str):
        words = words_of(parameter.full_key)
        if number in range(len(words)):
            return words[int(number)]
        wants = ", ".join(f"{place} ({word})" for place, word in enumerate(words))
    elif isinstance(now, bool):
        if number in (0.0, 1.0):
            return bool(number)
        wants = "0 or 1"
    elif isinstance(now, int):
        if number.is_integer():
            return int(number)
        wants = "a whole number"
    if wants:
        where = f"{parameter.name}: {parameter.full_key}"
        raise ConfigError(f"{where} wants {wants}, given is {number:g}")
    return float(f"{number:.{DIGITS}g}")
