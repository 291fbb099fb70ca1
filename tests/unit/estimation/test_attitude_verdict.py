"""Tilted maps begin anew; an attitude that is not the camera's is left aside for a while."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from companion.estimation.attitude_verdict import (
    BEGUN_ANEW,
    FOLLOWED_AGAIN,
    MAX_TILT_RAD,
    MOST_ANEW,
    MOUNT_DISAGREES,
    NOT_FOLLOWED,
    AttitudeVerdict,
)
from companion.estimation.map_tilt import MAX_MOUNT_RAD
from companion.estimation.motion_filter import AttitudeHistory
from companion.geometry.transforms import (
    Array,
    quaternion_from_euler,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
)
from companion.messages import AttitudeSample
from tests.support.flights.scene import DOWN_LOOKING

T0_NS = 10**12
FRAME_S = 0.05
MAP_FROM_NED = rotation_from_vector(np.array([0.0, 0.0, 1.1]))


@dataclass
class Flight:
    """What is told, when, in a flight of so many seconds; see `fly`."""

    told: list[tuple[float, str]] = field(default_factory=list)
    anew_s: list[float] = field(default_factory=list)
    used: bool = True

    def when(self, what: str) -> list[float]:
        return [t_s for t_s, text in self.told if text == what]


def euler(t_s: float) -> Array:
    """A copter in wind that turns to and fro: roll, pitch and yaw, rad."""
    return np.array([
        0.10 * np.sin(2.1 * t_s) + 0.03 * np.sin(9.0 * t_s + 1),
        0.08 * np.sin(1.7 * t_s + 2),
        1.5 * np.sin(0.4 * t_s),
    ])  # fmt: skip


def body(t_s: float) -> Array:
    return rotation_from_quaternion(quaternion_from_euler(*euler(t_s)))


def on_gimbal(t_s: float) -> Array:
    return rotation_from_quaternion(quaternion_from_euler(0.0, 0.0, euler(t_s)[2]))


def fly(
    seconds: float,
    camera_at: Callable[[float, float], Array] = lambda t_s, since_s: body(t_s),
    stamp: Callable[[float, np.random.Generator], float] = lambda t_s, rng: t_s,
    mount: Array = DOWN_LOOKING,
    body_at: Callable[[float], Array] = body,
    ned_from_map: Array | None = None,
) -> Flight:
    """Fly with a camera turned as by `camera_at(t_s, since_s)`, since its map began."""
    rng = np.random.default_rng(4)
    history = AttitudeHistory()
    verdict = AttitudeVerdict(history)
    flight, began_s, n_told = Flight(), 0.0, 0
    for k in range(int(seconds / FRAME_S)):
        t_s = k * FRAME_S
        while n_told / 50 <= t_s:
            attitude = body_at(n_told / 50) @ rotation_from_vector(rng.normal(scale=1e-3, size=3))
            sample = AttitudeSample(
                T0_NS + int(n_told / 50 * 1e9), quaternion_from_rotation(attitude)
            )
            history.add(sample)
            verdict.add(sample)
            n_told += 1
        camera = MAP_FROM_NED @ camera_at(t_s, t_s - began_s) @ mount
        camera = camera @ rotation_from_vector(rng.normal(scale=1e-3, size=3))
        at_ns = T0_NS + int(stamp(t_s, rng) * 1e9)
        verdict.take(at_ns, camera, 0, camera)
        judged = verdict.judge(at_ns, lambda _: np.eye(3), DOWN_LOOKING, ned_from_map)
        if judged is not None:
            flight.told.append((t_s, judged.warning.what))
            if judged.reinitialise:
                flight.anew_s.append(t_s)
                began_s = t_s
    flight.used = verdict.used
    return flight


def bends(rate_deg_s: float, maps: int) -> Callable[[float, float], Array]:
    """Each of the first `maps` maps turns about the north axis, by 20 degrees at most."""
    begun: set[float] = set()

    def camera_at(t_s: float, since_s: float) -> Array:
        begun.add(round(t_s - since_s, 3))
        angle = np.radians(min(rate_deg_s * since_s, 20.0)) if len(begun) <= maps else 0.0
        return rotation_from_vector(np.array([angle, 0.0, 0.0])) @ body(t_s)

    return camera_at


@pytest.mark.parametrize(
    ("late_s", "jitter_s"), [(0.0, 0.0), (0.041, 0.03), (0.06, 0.0), (0.15, 0.03)]
)
def test_late_and_jittery_frames_cost_nothing(late_s: float, jitter_s: float) -> None:
    flight = fly(
        30.0, stamp=lambda t_s, rng: t_s + late_s + float(rng.uniform(-jitter_s, jitter_s))
    )
    assert flight.used
    assert not flight.told


@pytest.mark.parametrize("off_deg", [3.0, 5.0, 8.0])
def test_a_mount_that_is_a_little_off_throws_no_map_away(off_deg: float) -> None:
    turn = rotation_from_vector(np.radians(off_deg) * np.array([0.6, 0.64, 0.48]))
    flight = fly(30.0, mount=turn @ DOWN_LOOKING)
    assert not flight.anew_s
    assert flight.used


@pytest.mark.parametrize("off_deg", [15.0, 30.0])
def test_a_mount_that_is_far_off_throws_few_maps_away_and_is_named(off_deg: float) -> None:
    turn = rotation_from_vector(np.radians(off_deg) * np.array([0.6, 0.64, 0.48]))
    flight = fly(30.0, mount=turn @ DOWN_LOOKING)
    assert len(flight.anew_s) == MOST_ANEW
    assert len(flight.when(MOUNT_DISAGREES)) == 1


@pytest.mark.parametrize("rate_deg_s", [5.0, 10.0, 40.0])
def test_a_map_that_bends_begins_anew_once(rate_deg_s: float) -> None:
    """While the body yaws, the first degrees look like a mount that is stated wrongly."""
    flight = fly(30.0, bends(rate_deg_s, maps=1))
    known_s = np.degrees(MAX_TILT_RAD + MAX_MOUNT_RAD) / rate_deg_s
    assert flight.when(BEGUN_ANEW) == flight.anew_s
    assert len(flight.anew_s) == 1
    assert flight.anew_s[0] < known_s + 2.0
    assert flight.used


def test_a_map_that_is_placed_askew_begins_anew() -> None:
    askew = MAP_FROM_NED.T @ rotation_from_vector(np.radians([12.0, 0.0, 0.0]))
    assert fly(3.0, ned_from_map=askew).anew_s
    assert not fly(3.0, ned_from_map=MAP_FROM_NED.T).anew_s


def test_maps_that_never_agree_are_not_thrown_away_for_ever() -> None:
    """Each map tilts, so that it is not the maps: said in words, and tried again ever later."""
    flight = fly(60.0, bends(10.0, maps=1000))
    assert flight.when(MOUNT_DISAGREES)
    first_s = flight.when(MOUNT_DISAGREES)[0]
    assert len([t_s for t_s in flight.anew_s if t_s < first_s]) == MOST_ANEW
    assert first_s < 10.0
    assert len(flight.anew_s) <= 4 * MOST_ANEW
    again = flight.when(FOLLOWED_AGAIN)
    assert all(b - a > 9.0 for a, b in zip([first_s, *again], again, strict=False))


def test_a_gimbal_is_noticed_and_its_end_too() -> None:
    def camera_at(t_s: float, since_s: float) -> Array:
        return on_gimbal(t_s) if t_s < 25.0 else body(t_s)

    flight = fly(60.0, camera_at)
    (off_s,) = flight.when(NOT_FOLLOWED)
    (on_s,) = flight.when(FOLLOWED_AGAIN)
    assert off_s < 10.0
    assert 25.0 < on_s < 45.0
    assert not flight.anew_s
    assert flight.used


def test_a_gimbal_that_is_swept_over_a_body_that_hovers_is_noticed() -> None:
    """The map was straight for long, so that it is not the map."""

    def camera_at(t_s: float, since_s: float) -> Array:
        return rotation_from_vector(np.array([0.0, np.radians(np.clip(5 * (t_s - 20), 0, 30)), 0]))

    flight = fly(40.0, camera_at, body_at=lambda t_s: np.eye(3))
    assert len(flight.when(NOT_FOLLOWED)) == 1
    assert not flight.anew_s
    assert not flight.used
