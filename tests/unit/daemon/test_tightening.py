"""While armed, settings of the pose gate only become tighter, however a change comes."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from companion.config import (
    Config,
    FeedbackConfig,
    GeoreferenceConfig,
    Measurement,
    TelemetryConfig,
    TrackingConfig,
)
from companion.config.setting_keys import value_of_key, with_values
from companion.daemon.control.flight_parameters import PARAMETERS
from companion.daemon.control.reload import reloaded
from companion.daemon.control.tightening import WHILE_ARMED, may_change, tightened

FLYING = Config(
    feedback=FeedbackConfig(mode="odometry", global_position="sensor", flow="optical_flow"),
    telemetry=TelemetryConfig(use=("attitude", "imu")),
)
TIGHTER: dict[str, Any] = {
    "feedback.mode": "off", "feedback.global_position": "off", "feedback.flow": "off",
    "expert.feedback.max_sigma_m": 0.5,
    "expert.feedback.min_quality": 40, "expert.feedback.max_gap_ms": 100.0,
    "expert.feedback.resume_after_s": 2.0, "expert.feedback.max_jump_m": 0.5,
    "expert.georeference.min_travel_m": 6.0, "expert.georeference.max_sigma_scale": 0.05,
    "expert.tracking.min_inliers": 30, "telemetry.use": ("attitude",),
}  # fmt: skip
LOOSER: dict[str, Any] = {
    "feedback.mode": "vision_position", "feedback.global_position": "gps_input",
    "feedback.flow": "optical_flow_rad",
    "expert.feedback.max_sigma_m": 2.0, "expert.feedback.min_quality": 10,
    "expert.feedback.max_gap_ms": 300.0, "expert.feedback.resume_after_s": 0.5,
    "expert.feedback.max_jump_m": 2.0,
    "expert.georeference.min_travel_m": 1.0, "expert.georeference.max_sigma_scale": 0.3,
    "expert.tracking.min_inliers": 10, "telemetry.use": ("imu", "attitude", "satellites"),
}  # fmt: skip
FREE = {"expert.feedback.rate_hz": 60.0}
FIXED: dict[str, Any] = {
    "expert.feedback.set_origin": False, "feedback.origin_latitude_deg": 47.0,
    "feedback.origin_longitude_deg": 8.0, "feedback.origin_altitude_m": 400.0,
    "feedback.obstacle_distance": True,
    "feedback.obstacles_3d": True,
}  # fmt: skip


def test_each_key_of_feedback_is_in_the_table() -> None:
    keys = {f"feedback.{each.name}" for each in dataclasses.fields(FeedbackConfig)}
    ruled = {name.removeprefix("expert.") for name in WHILE_ARMED if "feedback." in name}
    assert ruled == keys
    assert {*TIGHTER, *FREE, *FIXED} == {*LOOSER, *FREE, *FIXED} == set(WHILE_ARMED)


@pytest.mark.parametrize("name", WHILE_ARMED)
def test_each_key_goes_one_way(name: str) -> None:
    now = value_of_key(FLYING, name)
    assert may_change(name, now, now)
    if name in FREE:
        assert may_change(name, now, FREE[name]) and may_change(name, FREE[name], now)
    elif name in FIXED:
        assert not may_change(name, now, FIXED[name]) and not may_change(name, FIXED[name], now)
    else:
        assert may_change(name, now, TIGHTER[name])
        assert not may_change(name, now, LOOSER[name])
        assert not may_change(name, TIGHTER[name], now)


@pytest.mark.parametrize("name", sorted({*LOOSER, *FIXED}))
def test_what_is_read_again_waits_where_it_is_looser(name: str) -> None:
    wanted = with_values(FLYING, {name: (LOOSER | FIXED)[name], "expert.depth.stride": 4})
    going_on, waiting = tightened(FLYING, wanted)
    assert waiting == {name: (LOOSER | FIXED)[name]}
    assert going_on == with_values(FLYING, {"expert.depth.stride": 4})
    assert with_values(going_on, waiting) == wanted


@pytest.mark.parametrize("name", sorted({*TIGHTER, *FREE}))
def test_what_is_read_again_counts_where_it_is_tighter(name: str) -> None:
    wanted = with_values(FLYING, {name: (TIGHTER | FREE)[name]})
    assert tightened(FLYING, wanted) == (wanted, {})


@pytest.mark.parametrize("use", [(*FLYING.telemetry.use, "satellites"), ("attitude",)])
def test_what_is_believed_stays_as_at_the_start(use: tuple[Measurement, ...]) -> None:
    """Whether armed or not: one flight believes one list."""
    read = with_values(FLYING, {"telemetry.use": use, "expert.depth.stride": 4})
    config, cannot = reloaded(FLYING, read)
    assert cannot == ["telemetry.use"]
    assert config == with_values(FLYING, {"expert.depth.stride": 4})


def test_feedback_that_is_off_stays_off() -> None:
    off = with_values(FLYING, {"feedback.mode": "off"})
    assert tightened(off, FLYING)[0].feedback.mode == "off"
    vision = with_values(FLYING, {"feedback.mode": "vision_position"})
    assert tightened(vision, FLYING)[0].feedback.mode == "vision_position"


def test_a_map_begun_in_the_air_believes_no_sooner() -> None:
    eager = dataclasses.replace(
        FLYING, georeference=GeoreferenceConfig(min_travel_m=0.5, max_sigma_scale=0.5),
        tracking=TrackingConfig(min_inliers=5),
    )  # fmt: skip
    assert tightened(FLYING, eager)[0] == FLYING


def test_parameters_of_other_sections_are_free() -> None:
    others = [each.full_key for each in PARAMETERS.values() if each.full_key not in WHILE_ARMED]
    assert "depth.enabled" in others
    assert all(may_change(name, 1, 2) and may_change(name, 2, 1) for name in others)
