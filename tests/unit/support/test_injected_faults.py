"""Injected faults of the benchmark."""

from __future__ import annotations

import numpy as np

from companion.geometry.transforms import angle_between, rotation_from_quaternion
from companion.messages import Frame, Warned
from companion.telemetry import (
    AttitudeSample,
    HeightSample,
    PositionSample,
    PositionSource,
    Telemetry,
)
from tests.bench.accuracy.injected_faults import FAULTS, Fault, Span

SPAN = Span(1_000_000_000, 11_000_000_000)
LEVEL = np.array([1.0, 0, 0, 0])


def fault(name: str) -> Fault:
    (found,) = (f for f in FAULTS if f.name == name)
    return found


def samples() -> list[Telemetry]:
    times = range(SPAN.start_ns, SPAN.stop_ns, 100_000_000)
    return [s for t in times for s in (AttitudeSample(t, LEVEL, np.ones(3)), HeightSample(t, 5.0))]


def frames() -> list[Frame | Warned]:
    grey = np.full((4, 6), 100, np.uint8)
    rgb = np.repeat(grey[..., None], 3, 2)
    return [Frame(k, SPAN.start_ns + k * 100_000_000, grey, rgb) for k in range(100)]


def filmed(name: str) -> list[Frame]:
    return [f for f in fault(name).pictures(frames(), SPAN) if isinstance(f, Frame)]


def test_no_fault_changes_nothing() -> None:
    assert fault("none").telemetry(samples(), SPAN)[0].t_ns == SPAN.start_ns
    assert len(filmed("none")) == 100


def test_without_attitude_the_rest_of_telemetry_stays() -> None:
    left = fault("no attitude").telemetry(samples(), SPAN)
    assert len(left) == 100
    assert all(isinstance(s, HeightSample) for s in left)


def test_an_offset_attitude_is_off_by_five_degrees() -> None:
    (first, *_) = fault("attitude off by 5 degrees").telemetry(samples(), SPAN)
    assert isinstance(first, AttitudeSample)
    off = angle_between(np.eye(3), rotation_from_quaternion(first.ned_from_body))
    assert np.isclose(np.degrees(off), 5.0)
    assert first.rates_body_rad_s is not None
    assert np.isclose(np.linalg.norm(first.rates_body_rad_s), np.sqrt(3))


def test_late_telemetry_is_all_there() -> None:
    late = fault("telemetry 60 ms late").telemetry(samples(), SPAN)
    assert [s.t_ns - 60_000_000 for s in late] == [s.t_ns for s in samples()]


def test_silent_telemetry_leaves_three_seconds_out() -> None:
    left = fault("telemetry silent for 3 s").telemetry(samples(), SPAN)
    assert len(samples()) - len(left) == 2 * 30
    assert max(np.diff([s.t_ns for s in left])) == 3_100_000_000


def test_an_image_dropout_lasts_two_seconds() -> None:
    blind = [f for f in filmed("blind for 2 s") if (f.grey > 250).all()]
    assert len(blind) == 20
    assert fault("blind for 2 s").dropout_ns(SPAN) == (blind[0].t_ns, blind[-1].t_ns + 100_000_000)


def test_dropped_frames_are_the_same_each_time() -> None:
    kept = [f.seq for f in filmed("30 % of frames dropped")]
    assert kept == [f.seq for f in filmed("30 % of frames dropped")]
    assert 55 < len(kept) < 85
    assert len(filmed("two of three frames dropped")) == 34


def test_exposure_steps_and_blur_change_images_only() -> None:
    assert {int(f.grey[0, 0]) for f in filmed("exposure steps")} == {100, 45, 150, 70}
    assert len(filmed("motion blur")) == 100


def test_a_wrong_velocity_is_turned_and_too_large() -> None:
    right = PositionSample(5, PositionSource.GPS, np.zeros(3), np.array([2.0, 0.0, -1.0]))
    untold = PositionSample(6, PositionSource.GPS, np.zeros(3))
    wrong, same = fault("velocity 10 % and 8 degrees off").telemetry([right, untold], SPAN)
    assert same is untold
    assert isinstance(wrong, PositionSample) and wrong.velocity_ned_m_s is not None
    turned = np.radians(8.0)
    expected = [2.2 * np.cos(turned), 2.2 * np.sin(turned), -1.1]
    assert np.allclose(wrong.velocity_ned_m_s, expected)


def test_low_contrast_pictures_have_little_contrast_and_noise() -> None:
    steps = np.repeat(np.array([[28, 228]], np.uint8), 300, 0)
    frame = Frame(0, SPAN.start_ns, steps, np.repeat(steps[..., None], 3, 2))
    (seen,) = fault("faint pictures").pictures([frame], SPAN)
    assert isinstance(seen, Frame)
    dark, light = seen.grey[:, 0], seen.grey[:, 1]
    assert abs(light.mean() - dark.mean() - 30.0) < 1.0
    assert 1.0 < dark.std() < 2.0
