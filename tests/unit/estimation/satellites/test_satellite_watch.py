"""Satellites against vision on made-up flights: what is doubted, how soon, and what is not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from companion.estimation.satellites.satellite_watch import (
    GONE_NS,
    POOR_M,
    SETTLED_S,
    USED_AGAIN,
    WITHDRAWN,
    Doubt,
    SatelliteWatch,
    doubts,
)
from companion.geometry.transforms import Array, Pose, Similarity, rotation_from_vector
from companion.messages import Georeference, Warned
from companion.pilot_messages import OF_WARNING
from companion.telemetry import PositionSample, PositionSource

S = 1_000_000_000
START_NS = 10**18
FAULT_S = 30.0
WORLD_FROM_MAP = Similarity(
    4.0, rotation_from_vector(np.array([0.1, -0.05, 2.0])), np.array([50.0, -20.0, 7.0])
)
PLACED = Georeference(WORLD_FROM_MAP, 0.008, 0.01, "GPS and velocity", 60, 0.6)
CAMERA_FROM_BODY = Pose(rotation_from_vector(np.array([1.2, 0.3, 0.0])), np.array([0.2, 0.1, -0.1]))
Path = Callable[[float], Array]


def circle(t_s: float) -> Array:
    """At 5 m/s, 25 m wide, 20 m high."""
    return np.array([25 * np.cos(0.2 * t_s), 25 * np.sin(0.2 * t_s), -20.0])


def hover(t_s: float) -> Array:
    return np.array([3.0, 4.0, -20.0])


def line(t_s: float) -> Array:
    """There and back at 8 m/s, turning in a second."""
    phase = ((t_s + 3.0) % 20.0) - 10.0
    return np.array([8.0 * (10.0 - abs(phase)), 0.0, -30.0 + 2.0 * np.sin(0.3 * t_s)])


def departure(t_s: float) -> Array:
    """Over one spot, then north at 8 m/s."""
    return np.array([8.0 * max(t_s - FAULT_S, 0.0), 0.0, -20.0])


class Flown:
    """Frames at 20 Hz, GPS at 5 Hz with an error that wanders by a metre, 0.2 s late."""

    def __init__(self, path: Path, seed: int = 0) -> None:
        self.path, self.rng = path, np.random.default_rng(seed)
        self.watch = SatelliteWatch(CAMERA_FROM_BODY)
        self.wander = np.zeros(3)
        self.t_s = 0.0
        self.map_id = 0
        self.tracked = True
        self.near_limits = False
        self.astray_m = np.zeros(3)
        """By which vision is off."""
        self.velocity_unproved = False
        self.used: list[tuple[float, bool]] = []
        self.frozen: Array | None = None

    def fly(
        self, seconds: float, off: Path = lambda _: np.zeros(3), *, stands: bool = False,
        silent: bool = False, sigma_m: float = 1.2, heard: bool = True, drift: float = 0.0,
        strays_m_s: Array | None = None,
    ) -> list[Warned]:  # fmt: skip
        """`off` is by seconds since this began; `drift` that of vision, as a share of the way."""
        said: list[Warned] = []
        began_s = self.t_s
        for step in range(round(seconds * 20)):
            self.t_s = began_s + 0.05 * (step + 1)
            t_ns = START_NS + round(self.t_s * S)
            if strays_m_s is not None:
                self.astray_m = self.astray_m + 0.05 * strays_m_s
            seen = self.camera_at(self.path(self.t_s) * (1 + drift) + self.astray_m)
            self.watch.take_frame(
                t_ns, self.map_id, seen if self.tracked else None, PLACED, self.near_limits
            )
            if heard:
                self.watch.take_time(t_ns)
            if step % 4 == 0 and not silent:
                self.take_gps(t_ns - S // 5, off(self.t_s - began_s - 0.2), stands, sigma_m)
            said += self.watch.warnings()
        return said

    def take_gps(self, t_ns: int, off_m: Array, stands: bool, sigma_m: float) -> None:
        self.wander += -self.wander * 0.2 / 30 + self.rng.normal(0, 0.08, 3) * [1, 1, 1.5]
        at = self.path(1e-9 * (t_ns - START_NS)) + self.wander + off_m
        at = at + self.rng.normal(0, 0.05, 3)
        self.frozen = (self.frozen if self.frozen is not None else at) if stands else None
        sample = PositionSample(
            t_ns, PositionSource.GPS, at if self.frozen is None else self.frozen, None, sigma_m
        )
        self.used.append((self.t_s, self.watch.may_use(sample, self.velocity_unproved)))

    def camera_at(self, place: Array) -> Pose:
        """`map_from_camera` of a body that is there, level."""
        world_from_camera = Pose(np.eye(3), place) @ CAMERA_FROM_BODY.inverse()
        inverse = WORLD_FROM_MAP.inverse()
        return Pose(
            inverse.rotation @ world_from_camera.rotation,
            inverse.apply(world_from_camera.translation[None])[0],
        )


def faulty(path: Path, **how: object) -> tuple[Flown, list[Warned]]:
    flown = Flown(path)
    assert flown.fly(FAULT_S) == []
    return flown, flown.fly(8.0, **how)  # type: ignore[arg-type]


def after_s(warning: Warned) -> float:
    return 1e-9 * (warning.t_ns - START_NS) - FAULT_S


@pytest.mark.parametrize("path", [circle, hover, line])
@pytest.mark.parametrize("seed", range(2))
def test_no_word_about_satellites_that_wander(path: Path, seed: int) -> None:
    flown = Flown(path, seed)
    assert flown.fly(60.0) == []
    assert all(used for _, used in flown.used)


@pytest.mark.parametrize("unproved", [False, True])
def test_a_map_that_may_be_of_a_wrong_velocity_says_nothing_of_satellites(unproved: bool) -> None:
    """It is 15 % too large."""
    flown = Flown(circle)
    flown.velocity_unproved = unproved
    said = [each.what for each in flown.fly(30.0, drift=0.15)]
    assert said == ([] if unproved else [Doubt.PULL.value])


def test_a_receiver_that_states_less_may_wander_more() -> None:
    """By a metre in two seconds, there and back, where it states 6 m."""

    def wander(t_s: float) -> Array:
        return np.array([1.5 * np.sin(0.35 * t_s), 1.5 * np.cos(0.5 * t_s), 0.0])

    assert Flown(circle).fly(40.0, wander, sigma_m=6.0) == []
    assert Flown(circle).fly(40.0, wander, sigma_m=1.0) != []


def test_no_word_about_stamps_that_are_late() -> None:
    """By 0.3 s, which at turns in no time is five metres."""
    flown = Flown(line)
    assert flown.fly(60.0, lambda t: line(t - 0.3) - line(t)) == []
    # what it has shown does not count for a fault: the next pull is said as soon
    t_s = flown.t_s
    said = flown.fly(6.0, lambda t: line(t_s + t - 0.3) - line(t_s + t) + [max(t, 0.0), 0, 0])
    assert [each.what for each in said] == [Doubt.PULL.value]


def test_no_word_about_vision_that_drifts() -> None:
    """By its scale, one percent, which is stated."""
    assert Flown(circle).fly(60.0, drift=0.01) == []


@pytest.mark.parametrize("path", [circle, hover, line])
def test_a_pull_of_a_metre_per_second_is_said_within_three_seconds(path: Path) -> None:
    _, said = faulty(path, off=lambda t: np.array([0.6, 0.8, 0.0]) * max(t, 0.0))
    assert [each.what for each in said] == [Doubt.PULL.value]
    assert after_s(said[0]) < 3.0


@pytest.mark.parametrize("path", [circle, hover, line])
def test_a_jump_is_said_at_once_and_never_used(path: Path) -> None:
    flown, said = faulty(path, off=lambda _: np.array([30.0, -40.0, 0.0]))
    assert [each.what for each in said] == [Doubt.JUMP.value]
    assert after_s(said[0]) < 0.6
    assert not any(used for t_s, used in flown.used if t_s > FAULT_S + 0.2)


def test_nothing_is_held_against_a_map_that_is_young_or_of_a_lens_that_was_guessed() -> None:
    young = Flown(circle)
    assert young.fly(SETTLED_S - 0.5, lambda t: np.array([1.0, 0, 0]) * max(t, 0.0)) == []
    guessed = Flown(circle)
    guessed.watch = SatelliteWatch(CAMERA_FROM_BODY, calibrated=False)
    assert guessed.fly(30.0, lambda t: np.array([1.0, 0, 0]) * max(t, 0.0)) == []
    said = guessed.fly(5.0, silent=True)
    assert [each.what for each in said] == [Doubt.GONE.value]


def test_a_single_outlier_is_left_out_without_a_word() -> None:
    flown, said = faulty(circle, off=lambda t: np.array([30.0, 0, 0]) * (1.9 < t < 2.1))
    assert said == []
    assert sum(not used for _, used in flown.used) == 1


def test_a_receiver_that_stands_is_said() -> None:
    _, said = faulty(circle, stands=True)
    assert [each.what for each in said] == [Doubt.STANDS.value]
    assert after_s(said[0]) < 3.0


def test_standing_over_one_spot_is_no_fault() -> None:
    assert faulty(hover, stands=True)[1] == []


def test_height_is_watched() -> None:
    _, said = faulty(circle, off=lambda t: np.array([0.0, 0.0, -2.0]) * max(t, 0.0))
    assert [each.what for each in said] == [Doubt.HEIGHT.value]


def test_a_track_that_is_turned_is_said() -> None:
    """By the heading of the map, or of a receiver, from where the vehicle sets off."""
    turn = rotation_from_vector(np.array([0.0, 0.0, np.radians(30.0)]))
    start = departure(FAULT_S)
    _, said = faulty(departure, off=lambda t: (turn - np.eye(3)) @ (departure(FAULT_S + t) - start))
    assert [each.what for each in said] == [Doubt.TURNED.value]


def test_a_receiver_that_falls_silent_is_said_and_one_of_a_silent_link_is_not() -> None:
    _, said = faulty(circle, silent=True)
    assert [each.what for each in said] == [Doubt.GONE.value]
    assert after_s(said[0]) < 1e-9 * GONE_NS + 0.3
    flown, quiet = faulty(circle, silent=True, heard=False)
    assert quiet == [] and flown.fly(10.0) == []


def test_a_receiver_that_is_heard_seldom_is_not_gone() -> None:
    flown = Flown(circle)
    for _ in range(30):
        assert flown.fly(1.8, silent=True) + flown.fly(0.2) == []


def test_positions_that_state_no_accuracy_are_not_used() -> None:
    flown, said = faulty(circle, sigma_m=2 * POOR_M)
    assert [each.what for each in said] == [Doubt.POOR.value]
    assert not flown.used[-1][1]


def test_an_accuracy_about_the_limit_is_said_once() -> None:
    flown = Flown(circle)
    flown.tracked = False
    assert flown.fly(5.0) == []
    said: list[Warned] = []
    for _ in range(10):
        said += flown.fly(0.4, sigma_m=1.2 * POOR_M) + flown.fly(1.0, sigma_m=0.8 * POOR_M)
    assert [each.what for each in said] == [Doubt.POOR.value]
    assert [each.what for each in flown.fly(6.0)] == [USED_AGAIN]


def test_they_are_used_again_where_they_are_as_before() -> None:
    flown, _ = faulty(circle, off=lambda _: np.array([30.0, -40.0, 0.0]))
    assert flown.fly(20.0, off=lambda _: np.array([30.0, -40.0, 0.0])) == []
    back = flown.fly(20.0)
    assert [each.what for each in back] == [USED_AGAIN]
    assert back[0].good and flown.used[-1][1]
    assert flown.fly(30.0) == []


def test_a_pull_that_stops_elsewhere_stays_doubted() -> None:
    flown, _ = faulty(circle, off=lambda t: np.array([1.0, 0, 0]) * max(t, 0.0))
    assert flown.fly(30.0, off=lambda _: np.array([25.0, 0.0, 0.0])) == []
    assert not flown.used[-1][1]


def test_where_the_map_of_before_is_gone_they_are_used_again_after_a_while() -> None:
    flown, _ = faulty(circle, off=lambda _: np.array([30.0, -40.0, 0.0]))
    flown.map_id = 7
    said = flown.fly(45.0, off=lambda _: np.array([30.0, -40.0, 0.0]))
    assert [each.what for each in said] == [USED_AGAIN]


def test_a_receiver_that_comes_back_where_nothing_is_known_of_it_is_used_at_once() -> None:
    """A map that has no scale yet needs it."""
    blind, guessed = Flown(circle), Flown(circle)
    blind.tracked = False
    guessed.watch = SatelliteWatch(CAMERA_FROM_BODY, calibrated=False)
    for flown in (blind, guessed):
        assert flown.fly(20.0) == []
        said = flown.fly(5.0, silent=True) + flown.fly(1.0)
        assert [each.what for each in said] == [Doubt.GONE.value, USED_AGAIN]
        assert flown.used[-1][1]


def test_where_vision_is_gone_for_long_they_are_used_again() -> None:
    flown, _ = faulty(circle, off=lambda _: np.array([30.0, -40.0, 0.0]))
    flown.tracked = False
    assert flown.fly(25.0, off=lambda _: np.array([30.0, -40.0, 0.0])) == []
    said = flown.fly(10.0, off=lambda _: np.array([30.0, -40.0, 0.0]))
    assert [each.what for each in said] == [USED_AGAIN]


STRAYS_M_S = np.array([-1.0, 1.4, 0.0])
PULL_M_S = np.array([0.6, 0.8, 0.0])


@pytest.mark.parametrize("path", [circle, hover, line])
def test_vision_near_its_limits_accuses_nobody(path: Path) -> None:
    flown = Flown(path)
    assert flown.fly(FAULT_S) == []
    flown.near_limits = True
    assert flown.fly(1.0, strays_m_s=STRAYS_M_S) == []
    flown.tracked = False
    assert flown.fly(1.0) == []
    assert all(used for _, used in flown.used)


@pytest.mark.parametrize("path", [circle, hover, line])
def test_vision_near_its_limits_still_sees_a_jump(path: Path) -> None:
    flown = Flown(path)
    flown.near_limits = True
    assert flown.fly(FAULT_S) == []
    said = flown.fly(3.0, off=lambda _: np.array([30.0, -40.0, 0.0]))
    assert [each.what for each in said] == [Doubt.JUMP.value]
    assert after_s(said[0]) < 0.6


@pytest.mark.parametrize("begins_another_map", [False, True])
def test_a_doubt_is_withdrawn_where_vision_fails_right_after_it(begins_another_map: bool) -> None:
    flown = Flown(circle)
    assert flown.fly(FAULT_S) == []
    said = flown.fly(2.0, strays_m_s=STRAYS_M_S)
    assert [each.what for each in said] == [Doubt.PULL.value]
    flown.tracked = False
    said = flown.fly(0.2 if begins_another_map else 0.6)
    if begins_another_map:
        flown.tracked, flown.map_id = True, 7
        said += flown.fly(0.2)
    assert [each.what for each in said] == [WITHDRAWN]
    assert flown.fly(0.4) == [] and flown.used[-1][1]


def test_vision_that_was_astray_and_comes_back_says_nothing_more() -> None:
    flown = Flown(circle)
    flown.fly(FAULT_S)
    flown.fly(2.0, strays_m_s=STRAYS_M_S)
    flown.tracked = False
    flown.fly(1.0)
    flown.tracked, flown.astray_m = True, np.zeros(3)
    assert flown.fly(30.0) == []


def test_vision_that_comes_back_and_still_contradicts_is_believed() -> None:
    flown = Flown(circle)
    flown.fly(FAULT_S)
    assert flown.fly(3.0, lambda t: PULL_M_S * max(t, 0.0)) != []
    flown.tracked = False
    said = flown.fly(1.0, lambda t: PULL_M_S * (3.0 + t))
    assert [each.what for each in said] == [WITHDRAWN]
    flown.tracked = True
    said = flown.fly(2.0, lambda t: PULL_M_S * (4.0 + t))
    assert [each.what for each in said] == [Doubt.PULL.value]


def test_vision_that_fails_long_after_its_word_is_still_believed() -> None:
    flown, _ = faulty(circle, off=lambda t: PULL_M_S * max(t, 0.0))
    flown.tracked = False
    assert flown.fly(10.0, lambda t: PULL_M_S * (8.0 + t)) == []
    assert not flown.used[-1][1]


def test_while_they_are_doubted_the_autopilots_own_estimate_is_not_used() -> None:
    """It follows its receiver; without one it goes on by other sensors."""
    pulled, _ = faulty(circle, off=lambda _: np.array([30.0, -40.0, 0.0]))
    silent, _ = faulty(circle, silent=True)
    for flown, used in ((pulled, False), (silent, True)):
        t_ns = START_NS + round(flown.t_s * S)
        own = PositionSample(t_ns, PositionSource.LOCAL, circle(flown.t_s))
        assert flown.watch.may_use(own) is used


def test_each_verdict_has_words_for_the_pilot() -> None:
    for what in [each.value for each in Doubt] + [USED_AGAIN, WITHDRAWN]:
        assert what in OF_WARNING
        assert doubts(Warned(0, what)) is (what not in (USED_AGAIN, WITHDRAWN))
    assert doubts(Warned(0, "the camera has gone")) is None
