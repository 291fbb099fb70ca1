"""What noise of rotations makes of places goes, where gyroscopes know turns better."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.georeference.steady_places import steadied
from companion.estimation.georeference.tracked_places import Places
from companion.estimation.inertial.turn_integral import TurnIntegral
from companion.geometry.transforms import Array, rotation_from_vector
from companion.telemetry import ImuSample
from tests.support.flights.measured_motion import turned, weaving

MOUNT = rotation_from_vector(np.array([0.3, -1.1, 0.8]))
"""`body_from_camera`."""
DEPTH_M = 25.0
JITTER_RAD = 3e-4
BIAS_RAD_S, NOISE_RAD_S, DELAY_S = np.array([0.004, -0.003, 0.005]), 0.004, 0.002


def _gyroscopes(rng: np.random.Generator, silent: bool = False) -> TurnIntegral:
    out, h = TurnIntegral(), 1e-3
    for t_s in np.arange(0.0, 12.0, 0.01):
        turn = turned(t_s).T @ turned(t_s + h)
        rates = np.array([turn[2, 1], turn[0, 2], turn[1, 0]]) / h + BIAS_RAD_S
        rates = rates + rng.normal(scale=NOISE_RAD_S, size=3)
        if not (silent and 2.0 < t_s < 11.0):
            out.take(ImuSample(round((t_s + DELAY_S) * 1e9), rates, np.zeros(3)))
    return out


def _flown(rng: np.random.Generator) -> tuple[Places, Array]:
    """Frames with noise of rotation, and their true places."""
    t_s = np.arange(1.0, 11.0, 0.05)
    true = np.array([weaving(each) for each in t_s])
    jitter = rng.normal(scale=JITTER_RAD, size=true.shape)
    cameras = np.array([turned(each) @ MOUNT for each in t_s])
    noisy = [camera @ rotation_from_vector(by) for camera, by in zip(cameras, jitter, strict=True)]
    aside = DEPTH_M * np.cross([0.0, 0.0, 1.0], jitter) + rng.normal(scale=1e-3, size=true.shape)
    where = true + np.einsum("nij,nj->ni", cameras, aside)
    return Places(np.round(t_s * 1e9).astype(np.int64), np.array(noisy), where, cameras), true


def _scatter(places: Places, true: Array) -> float:
    return float(np.diff(places.places - true, axis=0).std() / np.sqrt(2.0))


@pytest.mark.parametrize("off_rad", [0.0, 0.02])
def test_places_are_steadier_by_gyroscopes(off_rad: float) -> None:
    """With a mount that is a degree off, too."""
    rng = np.random.default_rng(0)
    places, true = _flown(rng)
    mount = MOUNT @ rotation_from_vector(np.array([off_rad, 0.0, -off_rad]))
    found = steadied(places, *_gyroscopes(rng).at(places.t_ns), mount)
    print(f"{_scatter(places, true) * 1e3:.1f} mm, then {_scatter(found, true) * 1e3:.1f} mm")
    assert _scatter(found, true) < 0.5 * _scatter(places, true)
    assert np.abs(np.mean(found.places - places.places, axis=0)).max() < 1e-3


@pytest.mark.parametrize("mount", [MOUNT, MOUNT @ rotation_from_vector(np.array([0.0, 1.0, 0.0]))])
def test_gyroscopes_that_say_nothing_make_nothing_worse(mount: Array) -> None:
    """They are silent for most of the time, or sit otherwise than stated."""
    rng = np.random.default_rng(1)
    places, true = _flown(rng)
    silent = bool(np.array_equal(mount, MOUNT))
    found = steadied(places, *_gyroscopes(rng, silent).at(places.t_ns), mount)
    assert _scatter(found, true) < 1.05 * _scatter(places, true)


def test_frames_without_noise_of_rotation_stay() -> None:
    rng = np.random.default_rng(2)
    places, true = _flown(rng)
    still = places._replace(places=true + rng.normal(scale=1e-3, size=true.shape))
    found = steadied(still, *_gyroscopes(rng).at(places.t_ns), MOUNT)
    assert _scatter(found, true) < 1.1 * _scatter(still, true)
