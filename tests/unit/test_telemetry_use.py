"""`telemetry.use`: what is believed of telemetry, and that nothing else decides about the pose."""

from __future__ import annotations

import typing
from contextlib import nullcontext

import numpy as np
import pytest

from companion.config import MEASUREMENTS, Config, Measurement, TelemetryConfig
from companion.estimation.attitude.camera_attitude import CameraAttitude
from companion.estimation.georeference.depth_scales import DepthScales
from companion.estimation.georeference.georeferencer import Georeferencer
from companion.estimation.inertial.acceleration_integral import AccelerationIntegral
from companion.estimation.localisation import LocalisationStage
from companion.geometry.camera import Camera
from companion.messages import Frame, FrameTracked
from companion.telemetry import (
    MEASURED,
    TELEMETRY,
    AirspeedSample,
    ArmedSample,
    AttitudeSample,
    DepthSample,
    GimbalSample,
    HeightSample,
    ImuSample,
    LandedSample,
    PositionSample,
    PositionSource,
    RangeSample,
    Telemetry,
    belief_in_words,
    is_believed,
)

LEVEL, ZERO = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
SAMPLES: list[tuple[Telemetry, Measurement | None]] = [
    (AttitudeSample(1, LEVEL), "attitude"),
    (ImuSample(1, ZERO, ZERO), "imu"),
    (PositionSample(1, PositionSource.LOCAL, ZERO), "position"),
    (PositionSample(1, PositionSource.GLOBAL, ZERO), "position"),
    (PositionSample(1, PositionSource.GPS, ZERO, ZERO), "satellites"),
    (RangeSample(1, 5.0), "range"),
    (HeightSample(1, 5.0), "height"),
    (AirspeedSample(1, 5.0), "airspeed"),
    (DepthSample(1, 5.0, 6.0, 7.0, 0.1), "depth"),
    (ArmedSample(1, True), None),
    (LandedSample(1, True), None),
    (GimbalSample(1, LEVEL), "attitude"),
]
CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


def test_every_kind_of_sample_and_of_position_is_classified() -> None:
    kinds = {kind for kind in TELEMETRY if kind is not PositionSample}
    assert set(MEASURED) == {*kinds, *PositionSource}
    assert {type(sample) for sample, _ in SAMPLES} == set(TELEMETRY)


def test_every_word_is_of_some_sample() -> None:
    assert {word for word in MEASURED.values() if word} == set(MEASUREMENTS)
    assert typing.get_args(Measurement) == MEASUREMENTS == Config().telemetry.use


@pytest.mark.parametrize(("sample", "word"), SAMPLES)
def test_a_sample_is_believed_by_its_word_alone(sample: Telemetry, word: Measurement) -> None:
    assert is_believed(sample, MEASUREMENTS)
    assert is_believed(sample, ()) == (word is None)
    assert is_believed(sample, [word])
    assert is_believed(sample, set(MEASUREMENTS) - {word}) == (word is None)


@pytest.mark.parametrize(
    ("use", "said"),
    [
        (MEASUREMENTS, ""),
        (MEASUREMENTS[::-1], ""),
        (("imu", "attitude"), "only attitude, imu is believed (telemetry.use)"),
        (("range",), "only range is believed (telemetry.use): without attitude no pose is sent"),
        ((), "nothing is believed (telemetry.use): without attitude no pose is sent"),
    ],
)
def test_the_user_is_told_what_is_believed(use: tuple[Measurement, ...], said: str) -> None:
    assert belief_in_words(use) == (said and f"of the autopilot's telemetry {said}")


@pytest.mark.parametrize("use", [MEASUREMENTS, ("attitude", "imu"), ("satellites",), ()])
def test_localisation_takes_what_is_believed_and_counts_everything(
    use: tuple[Measurement, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The count is how a replay as flown finds the samples that came before a frame."""
    taken: set[int] = set()
    for kind, method in (
        (Georeferencer, "take"), (AccelerationIntegral, "take"), (CameraAttitude, "add"),
        (DepthScales, "take"),
    ):  # fmt: skip
        monkeypatch.setattr(kind, method, lambda _self, sample: taken.add(id(sample)))
    stage = LocalisationStage(
        Config(telemetry=TelemetryConfig(use=use)), CAMERA, lambda _: nullcontext()
    )
    for sample, _ in SAMPLES:
        stage.step(sample)
    picture = np.zeros((48, 64), np.uint8)
    told = list(stage.step(Frame(0, 2, picture, np.zeros((48, 64, 3), np.uint8))))
    assert [each.n_samples for each in told if isinstance(each, FrameTracked)] == [len(SAMPLES)]
    assert taken == {id(sample) for sample, word in SAMPLES if word is None or word in use}
