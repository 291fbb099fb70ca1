"""Changes allowed while armed to settings that decide which poses the autopilot gets.

Limits may become tighter, feedback may be switched off; anything else waits for disarming. That
holds for a parameter, a command, a reloaded configuration, and the configuration read by a daemon
that starts in the air.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

from companion.config import Config
from companion.config.setting_keys import value_of_key, with_values

MayChange = Callable[[Any, Any], bool]
"""Rule of a key: (present value, wanted value) -> True if it may change while armed."""


def _to_less(now: float, wanted: float) -> bool:
    return wanted <= now


def _to_more(now: float, wanted: float) -> bool:
    return wanted >= now


def _to_off(now: str, wanted: str) -> bool:
    return wanted in (now, "off")


def _to_fewer(now: Collection[str], wanted: Collection[str]) -> bool:
    return set(wanted) <= set(now)


def _not_at_all(now: Any, wanted: Any) -> bool:
    return bool(wanted == now)


def _freely(now: Any, wanted: Any) -> bool:
    return True


WHILE_ARMED: Mapping[str, MayChange] = {
    "feedback.mode": _to_off,
    "feedback.global_position": _to_off,
    # how often, not what is believed; every value that it can have is one that autopilots take
    "expert.feedback.rate_hz": _freely,
    "expert.feedback.max_sigma_m": _to_less,
    "expert.feedback.min_quality": _to_more,
    "expert.feedback.max_gap_ms": _to_less,
    "expert.feedback.resume_after_s": _to_more,
    # what is further away than this is announced as a reset; a smaller one is announced sooner
    "expert.feedback.max_jump_m": _to_less,
    # an origin that is given in the air moves what the autopilot takes for its place
    "expert.feedback.set_origin": _not_at_all,
    "feedback.origin_latitude_deg": _not_at_all,
    "feedback.origin_longitude_deg": _not_at_all,
    "feedback.origin_altitude_m": _not_at_all,
    "feedback.flow": _to_off,
    # obstacle avoidance of the autopilot relies on these messages
    "feedback.obstacle_distance": _not_at_all,
    "feedback.obstacles_3d": _not_at_all,
    # a map begun in the air accepts its scale, and its frames, by these
    "expert.georeference.min_travel_m": _to_more,
    "expert.georeference.max_sigma_scale": _to_less,
    "expert.tracking.min_inliers": _to_more,
    # a reload never changes it; a daemon that starts in the air might
    "telemetry.use": _to_fewer,
}
"""Every key of [feedback], and those of other sections that decide which poses are sent."""


def may_change(name: str, now: Any, wanted: Any) -> bool:
    """True if a key may change to a value while armed; always so for keys without a rule."""
    return WHILE_ARMED.get(name, _freely)(now, wanted)


def tightened(running: Config, wanted: Config) -> tuple[Config, dict[str, Any]]:
    """The configuration in force while armed, and by key the changes that wait for disarming."""
    waiting = {
        name: value_of_key(wanted, name)
        for name in WHILE_ARMED
        if not may_change(name, value_of_key(running, name), value_of_key(wanted, name))
    }
    return with_values(wanted, {name: value_of_key(running, name) for name in waiting}), waiting
