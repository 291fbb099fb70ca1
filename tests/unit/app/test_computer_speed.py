from __future__ import annotations

import dataclasses

import pytest

from companion.app import computer_speed
from companion.app.computer_speed import (
    CANDIDATES,
    Speed,
    cores_wanted,
    fitting_profile,
    measured_speed,
    said,
    why_unfit,
)
from companion.config.computer_settings import NO_PROFILE
from companion.config_file import of_profile
from companion.dense.device_choice import MeasuredDevice

FAST = Speed(
    n_cores=8, frame_ms=5.0, frame_p95_ms=8.0, keyframe_ms=30.0, keyframes_per_s=2.0,
    depth_device="a GPU", depth_on_processor=False, depth_images_per_s=2000.0,
)  # fmt: skip


def slower(times: float, n_cores: int) -> Speed:
    return dataclasses.replace(
        FAST, n_cores=n_cores, frame_ms=5.0 * times, frame_p95_ms=8.0 * times,
        keyframe_ms=30.0 * times, depth_on_processor=True,
        depth_images_per_s=50.0 * n_cores / times,
    )  # fmt: skip


def test_profile_by_speed() -> None:
    assert fitting_profile(FAST) == "desktop"
    assert fitting_profile(slower(3.0, 4)) == "n100"
    assert fitting_profile(slower(5.0, 4)) == "pi5"
    assert fitting_profile(slower(8.0, 4)) == "pi4"
    assert fitting_profile(slower(20.0, 4)) == NO_PROFILE


def test_profiles_are_listed_by_what_they_demand() -> None:
    rates_hz = [of_profile(name).camera.rate_hz for name in CANDIDATES]
    assert rates_hz == sorted(rates_hz, reverse=True)
    assert of_profile("orin-nano").camera.rate_hz == of_profile("pi5").camera.rate_hz


def test_without_a_device_no_profile_with_a_dense_map_fits() -> None:
    speed = dataclasses.replace(FAST, depth_device="", depth_images_per_s=0.0)
    assert fitting_profile(speed) == "pi4"
    assert any("depth.enabled = false" in line for line in said(speed, "pi4"))


def test_few_cores_are_a_reason() -> None:
    speed = dataclasses.replace(slower(3.0, 1), depth_images_per_s=100.0)
    assert "cores" in why_unfit(speed, "n100")
    lines = said(speed, fitting_profile(speed))
    assert any(line.startswith("  n100") and "too much" in line for line in lines)


def test_cores_of_the_measured_daemon() -> None:
    # the live daemon of docs/performance.md: 1.03 cores of which 0.46 are localisation, 0.20 depth
    speed = dataclasses.replace(slower(1.0, 2), frame_ms=46.0, keyframes_per_s=0.0)
    assert abs(cores_wanted(speed, 10.0, depth_share=0.1) - 1.03) < 0.02


def test_localisation_of_the_sample_flight_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(computer_speed, "N_FRAMES", computer_speed.N_WARM_UP + 40)
    speed = measured_speed([MeasuredDevice("0:0", "none", "nobody", problem="broken")])
    assert 0.0 < speed.frame_ms <= speed.frame_p95_ms and speed.keyframe_ms > 0.0
    assert 0.1 < speed.keyframes_per_s < 10.0  # the sample has ten frames a second
    assert speed.depth_device == ""
