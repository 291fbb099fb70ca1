"""Tilted maps are reinitialised; an attitude not of the camera is ignored for a while."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from companion.estimation.attitude.attitude_history import AttitudeHistory
from companion.estimation.attitude.attitude_verdict import (
    BODY_FIXED_AGAIN,
    MAX_REINITIALISATIONS,
    MAX_TILT_RAD,
    MOUNT_DISAGREES,
    NOT_BODY_FIXED,
    REINITIALISED,
    AttitudeVerdict,
)
from companion.estimation.attitude.map_tilt import MAX_MOUNT_RAD
from companion.geometry.transforms import (
    Array,
    quaternion_from_euler,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
)
from companion.telemetry import AttitudeSample
from tests.support.flights.scene import DOWN_LOOKING

T0_NS = 10**12
FRAME_S = 0.05
MAP_FROM_NED = rotation_from_vector(np.array([0.0, 0.0, 1.1]))


@dataclass
class Flight:
    """Warnings of a flight with their times; see `fly`."""

    warned: list[tuple[float, str]] = field(default_factory=list)
    anew_s: list[float] = field(default_factory=list)
    used: bool = True

    def when(self, what: str) -> list[float]:
        return [t_s for t_s, text in self.warned if text == what]


def euler(t_s: float) -> Array:
    """A copter in wind that yaws back and forth: roll, pitch and yaw, rad."""
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
    """Fly with a camera rotated by `camera_at(t_s, since_s)`, since its map was initialised."""
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
        judged = verdict.check(at_ns, lambda _: np.eye(3), DOWN_LOOKING, ned_from_map)
        if judged is not None:
            flight.warned.append((t_s, judged.warning.what))
            if judged.reinitialise:
                flight.anew_s.append(t_s)
                began_s = t_s
    flight.used = verdict.used
    return flight


def bends(rate_deg_s: float, maps: int) -> Callable[[float, float], Array]:
    """Each of the first `maps` maps rotates about the north axis, by at most 20 degrees."""
    begun: set[float] = set()

    def camera_at(t_s: float, since_s: float) -> Array:
        begun.add(round(t_s - since_s, 3))
        angle = np.radians(min(rate_deg_s * since_s, 20.0)) if len(begun) <= maps else 0.0
        return rotation_from_vector(np.array([angle, 0.0, 0.0])) @ body(t_s)

    return camera_at


@pytest.mark.parametrize(
    ("late_s", "jitter_s"), [(0.0, 0.0), (0.041, 0.03), (0.06, 0.0), (0.15, 0.03)]
)
def test_late_and_jittery_frames_discard_no_map(late_s: float, jitter_s: float) -> None:
    flight = fly(
        30.0, stamp=lambda t_s, rng: t_s + late_s + float(rng.uniform(-jitter_s, jitter_s))
    )
    assert flight.used
    assert not flight.warned


@pytest.mark.parametrize("off_deg", [3.0, 5.0, 8.0])
def test_small_mount_error_discards_no_map(off_deg: float) -> None:
    turn = rotation_from_vector(np.radians(off_deg) * np.array([0.6, 0.64, 0.48]))
    flight = fly(30.0, mount=turn @ DOWN_LOOKING)
    assert not flight.anew_s
    assert flight.used


@pytest.mark.parametrize("off_deg", [15.0, 30.0])
def test_large_mount_error_discards_few_maps_and_is_reported(off_deg: float) -> None:
    turn = rotation_from_vector(np.radians(off_deg) * np.array([0.6, 0.64, 0.48]))
    flight = fly(30.0, mount=turn @ DOWN_LOOKING)
    assert len(flight.anew_s) == MAX_REINITIALISATIONS
    assert len(flight.when(MOUNT_DISAGREES)) == 1


@pytest.mark.parametrize("rate_deg_s", [5.0, 10.0, 40.0])
def test_bending_map_is_reinitialised_once(rate_deg_s: float) -> None:
    """While the body yaws, the first degrees look like a wrong mount."""
    flight = fly(30.0, bends(rate_deg_s, maps=1))
    known_s = np.degrees(MAX_TILT_RAD + MAX_MOUNT_RAD) / rate_deg_s
    assert flight.when(REINITIALISED) == flight.anew_s
    assert len(flight.anew_s) == 1
    assert flight.anew_s[0] < known_s + 2.0
    assert flight.used


def test_tilted_georeference_reinitialises_the_map() -> None:
    askew = MAP_FROM_NED.T @ rotation_from_vector(np.radians([12.0, 0.0, 0.0]))
    assert fly(3.0, ned_from_map=askew).anew_s
    assert not fly(3.0, ned_from_map=MAP_FROM_NED.T).anew_s


def test_reinitialisation_is_limited() -> None:
    """Each map tilts, so the maps are not the cause: reported, with growing retry times."""
    flight = fly(60.0, bends(10.0, maps=1000))
    assert flight.when(MOUNT_DISAGREES)
    first_s = flight.when(MOUNT_DISAGREES)[0]
    assert len([t_s for t_s in flight.anew_s if t_s < first_s]) == MAX_REINITIALISATIONS
    assert first_s < 10.0
    assert len(flight.anew_s) <= 4 * MAX_REINITIALISATIONS
    again = flight.when(BODY_FIXED_AGAIN)
    assert all(b - a > 9.0 for a, b in zip([first_s, *again], again, strict=False))


def test_gimbal_is_detected_and_its_end_too() -> None:
    def camera_at(t_s: float, since_s: float) -> Array:
        return on_gimbal(t_s) if t_s < 25.0 else body(t_s)

    flight = fly(60.0, camera_at)
    (off_s,) = flight.when(NOT_BODY_FIXED)
    (on_s,) = flight.when(BODY_FIXED_AGAIN)
    assert off_s < 10.0
    assert 25.0 < on_s < 45.0
    assert not flight.anew_s
    assert flight.used


@pytest.mark.parametrize(("swing_deg", "used"), [(4.0, True), (10.0, False)])
def test_autopilots_vertical_may_swing_about_a_map_known_to_be_level(
    swing_deg: float, used: bool
) -> None:
    """As that of an autopilot after seconds without aiding; camera and body turn alike."""

    def swung(t_s: float) -> Array:
        angle = np.radians(swing_deg) * np.sin(0.5 * (t_s - 20.0)) if t_s > 20.0 else 0.0
        return rotation_from_vector(np.array([0.0, angle, 0.0])) @ body(t_s)

    flight = fly(30.0, lambda t_s, since_s: body(t_s), body_at=swung, ned_from_map=MAP_FROM_NED.T)
    assert not flight.anew_s
    assert (not flight.warned) is used


def test_panned_gimbal_on_a_hovering_body_is_detected() -> None:
    """The map was consistent for long, so it is not the cause."""

    def camera_at(t_s: float, since_s: float) -> Array:
        return rotation_from_vector(np.array([0.0, np.radians(np.clip(5 * (t_s - 20), 0, 30)), 0]))

    flight = fly(40.0, camera_at, body_at=lambda t_s: np.eye(3))
    assert len(flight.when(NOT_BODY_FIXED)) == 1
    assert not flight.anew_s
    assert not flight.used
