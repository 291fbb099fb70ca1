"""Pictures that stand while the vehicle flies on, and such of noise, are not called tracked."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.attitude_checks import SIGHT_STANDS
from companion.geometry.camera import Camera
from companion.messages import Bytes, TrackState
from companion.slam.features.faint_pictures import detail_of
from tests.support.flights.rendered_flight import (
    CAMERA_DOWN,
    START_NS,
    Flown,
    Terrain,
    fly,
    leaning_path,
)

CAMERA = Camera(320, 240, 260.0, 258.0, 161.0, 118.0, body_from_camera=CAMERA_DOWN)
RATE_HZ, STANDS_S, SECONDS = 15.0, 9.0, 13.0
NOISE = 1.5
KNOWN_S = 0.5
"""Until it is known: as long as both could be within what is stated of them."""


def weaving(after_s: float) -> np.ndarray:
    """A place (3,) that goes north at 3 m/s, to both sides and up and down."""
    swing = np.sin(np.array([0.9, 1.1, 0.7]) * after_s)
    at = np.array([3.0 * after_s - 20.0, 0.0, -8.0]) + np.array([1.0, 1.5, 0.5]) * swing
    return np.asarray(at)


class Stuck:
    """A camera whose picture stands from a time on, with new noise on each."""

    def __init__(self) -> None:
        self._last: Bytes | None = None

    def __call__(self, after_s: float, grey: Bytes) -> Bytes:
        if after_s < STANDS_S or self._last is None:
            self._last = grey
        noise = np.random.default_rng(round(after_s * RATE_HZ)).normal(0, NOISE, grey.shape)
        return np.asarray(np.clip(self._last + noise, 0, 255), np.uint8)


@pytest.fixture(scope="module")
def flown() -> Flown:
    path = leaning_path(weaving, lambda after_s: 0.2 * np.sin(0.5 * after_s))
    return fly(CAMERA, path, Terrain(3, plane=True), SECONDS, RATE_HZ, seen=Stuck(), imu_seed=1)


def since_s(t_ns: int) -> float:
    return (t_ns - START_NS) * 1e-9


def test_until_then_it_is_tracked_and_sent(flown: Flown) -> None:
    sent_s = [since_s(pose.t_ns) for pose in flown.sent.poses]
    assert len([s for s in sent_s if STANDS_S - 2.0 < s < STANDS_S]) >= 2.0 * RATE_HZ - 1
    assert SIGHT_STANDS not in [what for t_ns, what in flown.warned if since_s(t_ns) < STANDS_S]


def test_it_is_not_called_tracked(flown: Flown) -> None:
    tracked_s = [since_s(t.t_ns) for t in flown.tracks if t.state is TrackState.TRACKING]
    assert max(tracked_s) < STANDS_S + KNOWN_S
    assert flown.warnings.count(SIGHT_STANDS) == 1


def test_no_pose_is_sent_that_stands(flown: Flown) -> None:
    """Until it is known pictures are believed, and what the gate bridges goes on as before."""
    off_m = {
        since_s(pose.t_ns): pose.world_from_body.translation - weaving(since_s(pose.t_ns))
        for pose in flown.sent.poses
    }
    last_m = off_m[max(s for s in off_m if s < STANDS_S)]
    for s in off_m:
        assert s < STANDS_S + KNOWN_S + 0.35
        assert s < STANDS_S or np.linalg.norm(off_m[s] - last_m) < 1.0


DARK_S, LIGHT_S = 6.0, 7.5


def dark(after_s: float, grey: Bytes) -> Bytes:
    """Dusk for a while, in which the ground's detail is a third of the noise."""
    if not DARK_S <= after_s < LIGHT_S:
        return grey
    seen = 128.0 + 0.33 * NOISE / detail_of(grey, 0.0) * (grey - 128.0)
    noise = np.random.default_rng(round(after_s * RATE_HZ)).normal(0, NOISE, grey.shape)
    return np.asarray(np.clip(seen + noise, 0, 255), np.uint8)


def test_a_picture_drowned_in_noise_is_not_tracked_and_afterwards_the_ground_is_again() -> None:
    path = leaning_path(weaving, lambda after_s: 0.2 * np.sin(0.5 * after_s))
    flown = fly(CAMERA, path, Terrain(3, plane=True), LIGHT_S + 2.0, RATE_HZ, seen=dark)
    tracked_s = [since_s(t.t_ns) for t in flown.tracks if t.state is TrackState.TRACKING]
    assert max(s for s in tracked_s if s < LIGHT_S) < DARK_S
    assert len([s for s in tracked_s if s > LIGHT_S + 0.5]) > 0.9 * 1.5 * RATE_HZ
