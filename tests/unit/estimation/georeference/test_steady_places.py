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


def _flown(rng: np.random.Generator, bent_rad: float = 0.0) -> tuple[Places, Array]:
    """Frames with noise of rotation, and their true places.

    The map is bent: from frame to frame rotations walk by so much.
    """
    t_s = np.arange(1.0, 11.0, 0.05)
    true = np.array([weaving(each) for each in t_s])
    jitter = rng.normal(scale=JITTER_RAD, size=true.shape)
    jitter += np.cumsum(rng.normal(scale=bent_rad, size=true.shape), axis=0)
    cameras = np.array([turned(each) @ MOUNT for each in t_s])
    noisy = [camera @ rotation_from_vector(by) for camera, by in zip(cameras, jitter, strict=True)]
    aside = DEPTH_M * np.cross([0.0, 0.0, 1.0], jitter) + rng.normal(scale=1e-3, size=true.shape)
    where = true + np.einsum("nij,nj->ni", cameras, aside)
    return Places(np.round(t_s * 1e9).astype(np.int64), np.array(noisy), where, cameras), true


def _steadied(places: Places, turns: TurnIntegral, mount: Array) -> Places:
    return steadied(places, *turns.at(places.t_ns), mount, turns.density_rad_s)


def _scatter(places: Places, true: Array) -> float:
    return float(np.diff(places.places - true, axis=0).std() / np.sqrt(2.0))


@pytest.mark.parametrize("off_rad", [0.0, 0.02])
def test_places_are_steadier_by_gyroscopes(off_rad: float) -> None:
    """With a mount that is a degree off, too."""
    rng = np.random.default_rng(0)
    places, true = _flown(rng)
    mount = MOUNT @ rotation_from_vector(np.array([off_rad, 0.0, -off_rad]))
    found = _steadied(places, _gyroscopes(rng), mount)
    print(f"{_scatter(places, true) * 1e3:.1f} mm, then {_scatter(found, true) * 1e3:.1f} mm")
    assert _scatter(found, true) < 0.5 * _scatter(places, true)
    assert np.abs(np.mean(found.places - places.places, axis=0)).max() < 1e-3


@pytest.mark.parametrize("mount", [MOUNT, MOUNT @ rotation_from_vector(np.array([0.0, 1.0, 0.0]))])
def test_gyroscopes_that_say_nothing_make_nothing_worse(mount: Array) -> None:
    """They are silent for most of the time, or sit otherwise than stated."""
    rng = np.random.default_rng(1)
    places, true = _flown(rng)
    silent = bool(np.array_equal(mount, MOUNT))
    found = _steadied(places, _gyroscopes(rng, silent), mount)
    assert _scatter(found, true) < 1.05 * _scatter(places, true)


def test_frames_without_noise_of_rotation_stay() -> None:
    rng = np.random.default_rng(2)
    places, true = _flown(rng)
    still = places._replace(places=true + rng.normal(scale=1e-3, size=true.shape))
    found = _steadied(still, _gyroscopes(rng), MOUNT)
    assert _scatter(found, true) < 1.1 * _scatter(still, true)


@pytest.mark.parametrize("off_rad", [0.0, 0.05])
def test_a_map_that_bends_for_seconds_is_straightened(off_rad: float) -> None:
    """By gyroscopes whose bias the autopilot's level shows; with a mount that is off, too."""
    rng = np.random.default_rng(3)
    places, true = _flown(rng, bent_rad=1e-3)
    off = rotation_from_vector(np.array([0.0, off_rad, 0.0]))
    attitudes = places.ned_from_camera
    places = places._replace(ned_from_camera=attitudes @ off)
    found = _steadied(places, _gyroscopes(rng), MOUNT @ off)
    for before, after in (
        (places.places - true, found.places - true),
        (_turned(places.rotations, attitudes), _turned(found.rotations, attitudes)),
    ):
        in_2_s = [float((each[40:] - each[:-40]).std(axis=0).max()) for each in (before, after)]
        print("off by {:.4f} in two seconds, then {:.4f}".format(*in_2_s))
        assert in_2_s[1] < 0.5 * in_2_s[0]


def test_what_is_seen_comes_nearer() -> None:
    """Places move by as much as the ground is away, which at first is a fifth as far."""
    rng = np.random.default_rng(4)
    places, true = _flown(rng)
    share = np.linspace(0.2, 1.0, len(true))[:, None]
    near = places._replace(places=true + share * (places.places - true))
    found = _steadied(near, _gyroscopes(rng), MOUNT)
    early = slice(0, len(true) // 4)
    assert _scatter(found.of(early), true[early]) < 0.7 * _scatter(near.of(early), true[early])


def _turned(rotations: Array, true: Array) -> Array:
    """Errors (N, 3) of rotations, axes of the map."""
    skews = rotations @ true.transpose(0, 2, 1)
    return np.stack([skews[:, 2, 1], skews[:, 0, 2], skews[:, 1, 0]], 1)
