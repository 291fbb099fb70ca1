"""Exposure for tracking in a closed loop with a simulated sensor: photons, noise, gain, delay."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
import pytest

from companion.messages import Bytes
from drivers.camera.exposure_choice import (
    BAND,
    MAX_BLUR_PX,
    MEAN,
    Exposure,
    ExposureChoice,
    ExposureRange,
)

RATE_HZ = 30.0
ABLE = ExposureRange((100, 200_000), (0, 255))
FULL_WELL, READ_NOISE = 10_000.0, 12.0
"""Electrons."""
GAINS: dict[str, Callable[[float], float]] = {
    "factors": lambda gain: max(gain, 1.0),
    "sixteenths": lambda gain: (gain + 16.0) / 16.0,
    "decibels": lambda gain: float(10 ** (gain * 0.1 / 20)),
}


class Sensor:
    """A sensor before a scene; settings show in the picture three frames later."""

    def __init__(self, light: float, gain: Callable[[float], float], gamma: float) -> None:
        self.light, self._gain, self._gamma = light, gain, gamma
        self._rng = np.random.default_rng(3)
        self._scene = self._rng.uniform(0.3, 1.7, (30, 40))
        self._in_force: deque[Exposure] = deque(maxlen=4)

    def picture(self, setting: Exposure) -> Bytes:
        self._in_force.append(setting)
        seen = self._in_force[0]
        electrons = self._rng.poisson(
            np.minimum(self.light * self._scene * seen.exposure_us, FULL_WELL)
        ) + self._rng.normal(scale=READ_NOISE, size=self._scene.shape)
        share = np.clip(electrons * self._gain(seen.gain or 0) / FULL_WELL, 0.0, 1.0)
        return np.asarray(np.rint(255.0 * share**self._gamma), np.uint8)


class Loop:
    """The choice and the sensor together."""

    def __init__(self, sensor: Sensor, start: Exposure, able: ExposureRange = ABLE) -> None:
        self.sensor = sensor
        self.choice = ExposureChoice(able, start, RATE_HZ)
        self._seq = 0

    def run(self, seconds: float, image_px_s: float) -> tuple[list[Exposure], list[float]]:
        """Settings after, and mean grey levels of, each picture."""
        settings, means = [], []
        for _ in range(round(seconds * RATE_HZ)):
            picture = self.sensor.picture(self.choice.now)
            self.choice.step(round(self._seq * 1e9 / RATE_HZ), picture, image_px_s)
            self._seq += 1
            settings.append(self.choice.now)
            means.append(float(picture.mean()))
        return settings, means


@pytest.mark.parametrize("gain", sorted(GAINS))
@pytest.mark.parametrize("gamma", [1.0, 0.45])
@pytest.mark.parametrize("light", [0.05, 0.4, 3.0])
@pytest.mark.parametrize("start", [Exposure(20_000, 0), Exposure(200, 200)])
def test_the_light_is_found_within_seconds_and_kept(
    gain: str, gamma: float, light: float, start: Exposure
) -> None:
    loop = Loop(Sensor(light, GAINS[gain], gamma), start)
    _, means = loop.run(10.0, 200.0)
    assert all(m < MEAN * BAND * 1.1 for m in means[-30:])
    settings, means = loop.run(20.0, 200.0)
    brightest = Exposure(loop.choice.longest_us(), 255)
    if settings[-1] != brightest:  # else there is not more light to be had
        assert MEAN / BAND / 1.1 < means[-1] < MEAN * BAND * 1.1
    assert len(set(settings[-300:])) <= 2, "it does not come to rest"


@pytest.mark.parametrize("image_px_s", [50.0, 300.0, 2000.0])
def test_nothing_blurs_by_more_than_it_may(image_px_s: float) -> None:
    loop = Loop(Sensor(0.1, GAINS["decibels"], 1.0), Exposure(30_000, 0))
    settings, _ = loop.run(5.0, image_px_s)
    assert all(s.exposure_us * 1e-6 * image_px_s <= MAX_BLUR_PX for s in settings)
    assert all(100 <= s.exposure_us <= 0.9e6 / RATE_HZ for s in settings)
    assert all(s.gain is not None and 0 <= s.gain <= 255 for s in settings)


def test_a_turn_shortens_the_exposure_at_once_and_gain_makes_up_for_it() -> None:
    loop = Loop(Sensor(0.3, GAINS["sixteenths"], 1.0), Exposure(10_000, 0))
    calm, _ = loop.run(10.0, 40.0)
    turning, means = loop.run(10.0, 1500.0)
    assert calm[-1].exposure_us > 10_000
    assert turning[0].exposure_us == 1000
    assert (turning[-1].gain or 0) > (calm[-1].gain or 0)
    assert MEAN / BAND / 1.1 < means[-1]
    after, _ = loop.run(20.0, 40.0)
    assert after[-1].exposure_us > 5_000 and (after[-1].gain or 0) < (turning[-1].gain or 0)


def test_in_bright_light_the_least_gain_is_used_and_little_is_white() -> None:
    sensor = Sensor(5.0, GAINS["decibels"], 1.0)
    loop = Loop(sensor, Exposure(5_000, 120))
    settings, _ = loop.run(10.0, 100.0)
    assert settings[-1].gain == 0
    assert np.count_nonzero(sensor.picture(settings[-1]) >= 250) < 0.03 * 30 * 40


def test_a_camera_without_gain_stays_within_its_exposures() -> None:
    able = ExposureRange((300, 4_000), None)
    loop = Loop(Sensor(0.01, GAINS["decibels"], 1.0), Exposure(1_000, None), able)
    settings, _ = loop.run(5.0, 10.0)
    assert settings[-1] == Exposure(4_000, None)
    loop.sensor.light = 1e3
    settings, _ = loop.run(5.0, 10.0)
    assert settings[-1] == Exposure(300, None)
