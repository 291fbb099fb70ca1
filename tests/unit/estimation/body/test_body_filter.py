"""The filter of the body: where it is after seconds without a tracked place, as it states."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from companion.estimation.body.aiding import AidedFlow, AidedHeight, AidedPlace, AidedRest
from companion.estimation.body.body_filter import BodyFilter
from companion.estimation.body.body_state import N_STATE, BodyState
from companion.estimation.inertial.acceleration_integral import AccelerationIntegral
from companion.geometry.transforms import Array, yaw_rotation
from tests.support.flights.measured_motion import (
    STEP_S,
    MeasuredMotion,
    hovering,
    straight,
    turned,
    velocity,
    weaving,
)

WORLD_FROM_NED = yaw_rotation(0.3)
"""The frame of the places is turned against the autopilot's north."""
SIGMA_M = 0.02
AIDED_S = 12.0
Place = Callable[[float], Array]


class Flown:
    """Aided 15 times a second up to AIDED_S, then by accelerations alone."""

    def __init__(self, path: Place, seed: int, seconds: float, barometer: bool = False) -> None:
        self.path, rng = path, np.random.default_rng(seed)
        self.integral = AccelerationIntegral()
        self.navigation = BodyFilter(self.integral)
        motion = MeasuredMotion(path, rng, AIDED_S + seconds + STEP_S)
        next_s = 0.0
        for sample in motion.samples():
            self.integral.take(sample)
            t_s = sample.t_ns * 1e-9
            if next_s <= t_s < AIDED_S:
                next_s += 1.0 / 15.0
                noisy = WORLD_FROM_NED @ path(t_s) + rng.normal(scale=SIGMA_M, size=3)
                turn = WORLD_FROM_NED @ turned(t_s) @ (motion.tilt @ turned(t_s)).T
                self.navigation.aid(AidedPlace(sample.t_ns, noisy, turn, SIGMA_M))
            if barometer and sample.t_ns % 200_000_000 == 10_000_000:
                height_m = 300.0 - path(t_s)[2] + rng.normal(scale=0.3)
                self.navigation.aid(AidedHeight(sample.t_ns, height_m))

    def error(self, t_s: float) -> tuple[Array, Array, float, float]:
        """Errors of place and velocity (3,), and what is stated of both."""
        found = self.navigation.at(round(t_s * 1e9))
        assert found is not None
        return (
            found.place_m - WORLD_FROM_NED @ self.path(t_s),
            found.velocity_m_s - WORLD_FROM_NED @ velocity(self.path, t_s),
            found.sigma_place_m,
            found.sigma_velocity_m_s,
        )


@pytest.mark.parametrize(("seconds", "most_m"), [(2.0, 0.25), (5.0, 1.5)])
def test_place_after_seconds_without_one(seconds: float, most_m: float) -> None:
    errors = [Flown(weaving, seed, seconds).error(AIDED_S + seconds - 0.05) for seed in range(4)]
    away_m = np.array([np.linalg.norm(place) for place, *_ in errors])
    assert away_m.max() < most_m
    assert away_m.max() > 0.0


def test_what_it_states_is_what_it_is_off_by() -> None:
    """Normalised squared errors: one per degree of freedom, over ten flights."""
    places, velocities = [], []
    for seed in range(10):
        place, speed, sigma_m, sigma_m_s = Flown(weaving, seed, 3.0).error(AIDED_S + 2.95)
        places.append(float(place @ place) / sigma_m**2 / 3.0)
        velocities.append(float(speed @ speed) / sigma_m_s**2 / 3.0)
    # the stated one is the largest of three axes
    assert 0.1 < float(np.mean(places)) < 1.5
    assert 0.1 < float(np.mean(velocities)) < 1.5


def test_velocity_is_known_while_it_is_aided() -> None:
    _, speed, _, sigma_m_s = Flown(weaving, 3, 0.0).error(AIDED_S - 0.02)
    assert float(np.linalg.norm(speed)) < 0.1
    assert sigma_m_s < 0.1


def test_places_may_come_before_the_accelerations_up_to_them() -> None:
    flown = Flown(hovering, 2, 0.0)
    place, *_ = flown.error(AIDED_S + 0.3)
    assert float(np.linalg.norm(place)) < 0.1
    assert flown.navigation.at(round((AIDED_S + 0.6) * 1e9)) is None


def test_a_frame_that_moves_takes_the_body_with_it() -> None:
    flown = Flown(weaving, 4, 1.0)
    before = flown.navigation.at(round((AIDED_S + 0.9) * 1e9))
    turn, about, to = yaw_rotation(-0.4), np.array([20.0, 5.0, -3.0]), np.array([1.0, 2.0, 3.0])
    flown.navigation.move(turn, about, to)
    flown.navigation.rescale(to, 1.02, 0.01)
    after = flown.navigation.at(round((AIDED_S + 0.9) * 1e9))
    assert before is not None and after is not None
    # but for what was measured since the last place, whose unit is the metre
    expected = to + 1.02 * turn @ (before.place_m - about)
    assert np.linalg.norm(after.place_m - expected) < 0.1
    assert np.linalg.norm(after.velocity_m_s - 1.02 * turn @ before.velocity_m_s) < 0.1


@pytest.mark.parametrize("off", [-0.06, 0.04])
def test_what_a_wrong_scale_has_taught_is_put_right_with_it(off: float) -> None:
    """A map whose scale is off for its first five seconds, in which the body has accelerated.

    What accelerometers seem to be off by then is of the map: believed, it would carry the body away
    once nothing is seen.
    """
    found_s, blind_s = 5.0, 5.0
    for seed in range(3):
        rng, integral = np.random.default_rng(seed), AccelerationIntegral()
        navigation, motion = BodyFilter(integral), MeasuredMotion(weaving, rng, AIDED_S + blind_s)
        scale, start_m, next_s = 1.0 + off, weaving(0.0), 0.0
        for sample in motion.samples():
            integral.take(sample)
            t_s = sample.t_ns * 1e-9
            if not next_s <= t_s < AIDED_S:
                continue
            if scale != 1.0 and t_s >= found_s:  # from now on it goes on as large as it is
                last_m = start_m + scale * (weaving(t_s) - start_m)
                navigation.rescale(last_m, 1.0 / scale, 0.005)
                start_m, scale = last_m + start_m - weaving(t_s), 1.0
            at_m = start_m + scale * (weaving(t_s) - weaving(0.0))
            at_m = at_m + rng.normal(scale=SIGMA_M, size=3)
            sigma_scale = abs(off) if next_s == 0.0 else None
            turn = turned(t_s) @ (motion.tilt @ turned(t_s)).T
            navigation.aid(AidedPlace(sample.t_ns, at_m, turn, SIGMA_M, sigma_scale))
            next_s += 1.0 / 15.0
        t_s = AIDED_S + blind_s - 0.05
        found = navigation.at(round(t_s * 1e9))
        assert found is not None
        error_m = found.place_m - start_m - weaving(t_s) + weaving(0.0)
        print(f"{error_m.round(2)} m off, {found.sigma_place_m:.2f} m stated")
        assert np.abs(error_m).max() < 3.0 * found.sigma_place_m and found.sigma_place_m < 1.0


def test_where_another_map_lies_says_nothing_of_the_motion() -> None:
    """It was placed where this navigation had the body."""
    flown = Flown(weaving, 3, 5.0)
    t_ns = round((AIDED_S + 4.5) * 1e9)
    before, at_m = flown.navigation.at(t_ns), np.array([50.0, -7.0, 3.0])
    flown.navigation.aid(AidedPlace(t_ns, at_m, WORLD_FROM_NED, SIGMA_M, 0.02))
    after = flown.navigation.at(t_ns)
    assert before is not None and after is not None
    np.testing.assert_array_equal(after.place_m, at_m)
    np.testing.assert_array_equal(after.velocity_m_s, before.velocity_m_s)
    assert after.sigma_velocity_m_s >= before.sigma_velocity_m_s
    assert flown.navigation.n_refused == {}


def test_a_place_that_cannot_be_is_refused_and_counted() -> None:
    flown = Flown(weaving, 5, 1.0)
    t_ns = round((AIDED_S + 0.5) * 1e9)
    wrong = WORLD_FROM_NED @ weaving(AIDED_S + 0.5) + [4.0, 0.0, 0.0]
    flown.navigation.aid(AidedPlace(t_ns, wrong, WORLD_FROM_NED, SIGMA_M))
    assert flown.navigation.n_refused == {"place": 1}
    place, *_ = flown.error(AIDED_S + 0.9)
    assert float(np.linalg.norm(place)) < 0.3


def test_places_refused_for_a_second_are_believed() -> None:
    flown = Flown(hovering, 6, 2.5)
    jump = np.array([4.0, -1.0, 0.0])
    for t_s in np.arange(AIDED_S, AIDED_S + 2.3, 1.0 / 15.0):
        at = WORLD_FROM_NED @ hovering(t_s) + jump
        flown.navigation.aid(AidedPlace(round(t_s * 1e9), at, WORLD_FROM_NED, SIGMA_M))
    found = flown.navigation.at(round((AIDED_S + 2.3) * 1e9))
    assert found is not None
    assert np.linalg.norm(found.place_m - WORLD_FROM_NED @ hovering(0.0) - jump) < 0.2


def test_a_wrong_place_before_a_blind_span_does_not_make_the_next_one_believed() -> None:
    """The last place before loss and the first after it are refused: two outliers, not a row."""
    flown = Flown(weaving, 5, 4.0)
    for t_s in (AIDED_S + 0.1, AIDED_S + 2.1):
        wrong = WORLD_FROM_NED @ weaving(t_s) + [0.0, 0.0, 3.0]
        flown.navigation.aid(AidedPlace(round(t_s * 1e9), wrong, WORLD_FROM_NED, SIGMA_M))
    assert flown.navigation.n_refused == {"place": 2}
    place, speed, *_ = flown.error(AIDED_S + 2.2)
    assert np.linalg.norm(place) < 0.5 and np.linalg.norm(speed) < 0.5


def test_an_outlier_does_not_make_the_rest_much_less_certain() -> None:
    flown, disturbed = Flown(weaving, 5, 1.0), Flown(weaving, 5, 1.0)
    t_s = AIDED_S + 0.1
    wrong = WORLD_FROM_NED @ weaving(t_s) + [0.0, 0.0, 3.0]
    disturbed.navigation.aid(AidedPlace(round(t_s * 1e9), wrong, WORLD_FROM_NED, SIGMA_M))
    sigma_m, stated_m = (each.error(AIDED_S + 0.5)[2] for each in (flown, disturbed))
    assert sigma_m < stated_m < 1.1 * sigma_m


def test_rests_refused_seconds_apart_do_not_stop_a_moving_body() -> None:
    flown = Flown(weaving, 5, 4.0)
    for i in range(45):
        t_s = AIDED_S + i / 15.0
        t_ns, at = round(t_s * 1e9), WORLD_FROM_NED @ weaving(t_s)
        flown.navigation.aid(AidedPlace(t_ns, at, WORLD_FROM_NED, SIGMA_M))
        if i in (14, 44):
            flown.navigation.aid(AidedRest(t_ns, 0.05))
    assert flown.navigation.n_refused == {"rest": 2}
    _, speed, *_ = flown.error(AIDED_S + 3.0)
    assert np.linalg.norm(speed) < 0.2


def test_rests_refused_in_a_row_stop_a_body_that_hit_the_ground() -> None:
    flown = Flown(straight, 5, 2.0)
    for t_s in np.arange(AIDED_S, AIDED_S + 0.9, 0.2).tolist():
        flown.navigation.aid(AidedRest(round(t_s * 1e9), 0.05))
    found = flown.navigation.at(round((AIDED_S + 0.81) * 1e9))
    assert found is not None
    assert np.linalg.norm(found.velocity_m_s) < 0.2


def test_without_accelerations_the_velocity_is_held_for_a_moment() -> None:
    """Nothing is reckoned, but a tracked body's velocity is known, as well as is stated."""
    rng, integral, squares = np.random.default_rng(8), AccelerationIntegral(), []
    navigation = BodyFilter(integral)
    for t_s in np.arange(0.0, AIDED_S, 1.0 / 15.0).tolist():
        t_ns = round(t_s * 1e9)
        seen = weaving(t_s) + rng.normal(scale=SIGMA_M, size=3)
        navigation.aid(AidedPlace(t_ns, seen, np.eye(3), SIGMA_M))
        assert navigation.at(t_ns) is None
        moving = navigation.moving(t_ns)
        assert moving is not None
        if t_s > 1.0:
            off = moving.velocity_m_s - velocity(weaving, t_s)
            squares.append(float(off @ off) / moving.sigma_velocity_m_s**2 / 3.0)
    assert 0.1 < float(np.mean(squares)) < 1.5
    assert navigation.moving(round((AIDED_S + 1.0) * 1e9)) is None


def test_accelerations_that_are_not_believed_yet_are_learnt_from_but_not_told() -> None:
    flown = Flown(weaving, 12, 3.0)
    flown.integral.believed = False
    t_ns = round((AIDED_S - 0.02) * 1e9)
    assert flown.navigation.at(t_ns) is None and flown.navigation.moving(t_ns) is None
    flown.integral.believed = True
    place, speed, sigma_m, _ = flown.error(AIDED_S + 2.9)
    assert np.linalg.norm(place) < 0.5 and np.linalg.norm(speed) < 0.4 and sigma_m < 0.5


def test_accelerations_that_cease_do_not_begin_the_motion_anew() -> None:
    """Velocity and bias go on over a gap of them; they aid again after it."""
    flown = Flown(weaving, 9, 1.0)
    known = flown.error(AIDED_S + 0.5)
    flown.integral.withdraw(round((AIDED_S + 0.6) * 1e9))
    at = WORLD_FROM_NED @ weaving(AIDED_S + 0.7)
    flown.navigation.aid(AidedPlace(round((AIDED_S + 0.7) * 1e9), at, WORLD_FROM_NED, SIGMA_M))
    moving = flown.navigation.moving(round((AIDED_S + 0.7) * 1e9))
    assert moving is not None
    off = moving.velocity_m_s - WORLD_FROM_NED @ velocity(weaving, AIDED_S + 0.7)
    assert np.linalg.norm(known[1]) < 0.2 and np.linalg.norm(off) < 0.6
    assert moving.sigma_velocity_m_s < 1.0


def test_what_comes_late_counts_at_its_own_time() -> None:
    """Places out of order give what they give in order, to rounding; older ones nothing."""
    in_order, late = Flown(weaving, 10, 1.5), Flown(weaving, 10, 1.5)
    rng = np.random.default_rng(11)
    places = []
    for t_s in np.linspace(AIDED_S + 0.1, AIDED_S + 1.2, 12).tolist():
        at = WORLD_FROM_NED @ weaving(t_s) + rng.normal(scale=SIGMA_M, size=3)
        places.append(AidedPlace(round(t_s * 1e9), at, WORLD_FROM_NED, SIGMA_M))
    for place in places:
        in_order.navigation.aid(place)
    for k in (0, 3, 1, 2, 4, 6, 5, 7, 8, 11, 10, 9):
        late.navigation.aid(places[k])
    at_ns = round((AIDED_S + 1.4) * 1e9)
    expected, found = in_order.navigation.at(at_ns), late.navigation.at(at_ns)
    assert expected is not None and found is not None
    np.testing.assert_allclose(found.place_m, expected.place_m, atol=1e-9)
    np.testing.assert_allclose(found.velocity_m_s, expected.velocity_m_s, atol=1e-9)
    assert found.sigma_velocity_m_s == pytest.approx(expected.sigma_velocity_m_s)
    late.navigation.aid(places[2]._replace(place_m=places[2].place_m + 0.05))
    after = late.navigation.at(at_ns)
    assert after is not None
    np.testing.assert_array_equal(after.place_m, found.place_m)


def test_a_frame_that_turns_takes_the_covariance_with_it() -> None:
    """Normalised errors squared stay what they were, but for the unit of the metre."""
    rng = np.random.default_rng(3)
    spread = rng.normal(size=(N_STATE, N_STATE)) * np.linspace(0.1, 2.0, N_STATE)
    state = BodyState(0, rng.normal(size=N_STATE), spread @ spread.T, yaw_rotation(0.2))
    turn, about, to = yaw_rotation(-1.4), np.array([2.0, 5.0, -3.0]), np.array([1.0, 2.0, 3.0])
    moved = state.moved(turn, about, to, 1.3)
    other = state._replace(mean=state.mean + rng.normal(scale=0.1, size=N_STATE))
    off = other.moved(turn, about, to, 1.3).mean - moved.mean
    before = other.mean - state.mean
    assert off @ np.linalg.solve(moved.covariance, off) == pytest.approx(
        before @ np.linalg.solve(state.covariance, before)
    )


def test_an_imu_that_falls_silent_ends_it() -> None:
    flown = Flown(weaving, 7, 0.0)
    assert flown.navigation.at(round((AIDED_S + 2.0) * 1e9)) is None


def test_flow_over_the_ground_bounds_the_drift() -> None:
    """Ten seconds without a place, with flow five times a second, one of them far off."""
    flown, unaided = (Flown(weaving, 2, 10.0) for _ in range(2))
    rng, sigma_hz, ground_down_m = np.random.default_rng(4), 0.02, -10.0
    assert not flown.navigation.knows_ground
    flown.navigation.lift_off(ground_down_m + 0.1, 0.15)
    assert flown.navigation.knows_ground
    for k, t_s in enumerate(np.arange(AIDED_S + 0.2, AIDED_S + 9.8, 0.2)):
        flow_hz = velocity(weaving, t_s) / (ground_down_m - weaving(t_s)[2])
        flow_hz = flow_hz + rng.normal(scale=sigma_hz, size=3) + 5.0 * (k == 20)
        covariance_hz2 = sigma_hz**2 * np.eye(3)
        flown.navigation.aid(AidedFlow(round(t_s * 1e9), flow_hz, covariance_hz2))
    assert flown.navigation.n_refused == {"flow": 1}
    place, speed, sigma_m, sigma_m_s = flown.error(AIDED_S + 9.9)
    assert float(np.linalg.norm(place)) < 1.0
    assert float(np.linalg.norm(speed)) < 0.2
    assert np.abs(place).max() < 3.5 * sigma_m and np.abs(speed).max() < 3.5 * sigma_m_s
    assert sigma_m < 0.5 * unaided.error(AIDED_S + 9.9)[2]
    flown.navigation.reset()
    assert not flown.navigation.knows_ground


@pytest.mark.parametrize(("height_m", "bounds"), [(3.0, True), (1.5, False)])
def test_flow_tells_the_climb_where_the_ground_is_not_near(height_m: float, bounds: bool) -> None:
    """Twenty seconds without a place, over ground that is so far below on average."""
    rng, sigma_hz, ground_down_m = np.random.default_rng(4), 0.02, -20.0 + height_m
    downs_m = []
    for seed in range(3):
        flown, unaided = (Flown(gently, seed, 20.0) for _ in range(2))
        flown.navigation.lift_off(ground_down_m, 0.15)
        for t_s in np.arange(AIDED_S + 0.2, AIDED_S + 19.8, 0.2):
            flow_hz = velocity(gently, t_s) / (ground_down_m - gently(t_s)[2])
            flow_hz = flow_hz + rng.normal(scale=sigma_hz, size=3)
            measured = AidedFlow(round(t_s * 1e9), flow_hz, sigma_hz**2 * np.eye(3))
            flown.navigation.aid(measured)
        downs_m.append([each.error(AIDED_S + 19.9)[0][2] for each in (flown, unaided)])
    aided_m, unaided_m = np.abs(downs_m).mean(0)
    assert bounds is bool(aided_m < 0.5 * unaided_m)


def gently(t_s: float) -> Array:
    """Place in NED, metres: 1 m to either side and 0.2 m up and down."""
    return np.array([0.5 * t_s, np.sin(0.9 * t_s), -20.0 + 0.2 * np.sin(0.6 * t_s)])


def test_flow_does_not_move_the_height() -> None:
    """Over roofs it is twice as fast as over the ground that is known."""
    flown, unaided = (Flown(weaving, 3, 4.0) for _ in range(2))
    flown.navigation.lift_off(-10.0, 0.15)
    for t_s in np.arange(AIDED_S + 0.2, AIDED_S + 3.8, 0.2):
        flow_hz = velocity(weaving, t_s) / 5.0
        flown.navigation.aid(AidedFlow(round(t_s * 1e9), flow_hz, 4e-4 * np.eye(3)))
    down, expected = (each.error(AIDED_S + 3.9)[0][2] for each in (flown, unaided))
    assert down == pytest.approx(expected, abs=0.1)


def test_a_barometer_bounds_the_drift_of_the_height() -> None:
    """Twenty seconds without a place; its zero is known from the time before."""
    end_s = AIDED_S + 19.9
    aided_m, unaided_m = (
        [Flown(weaving, seed, 20.0, barometer).error(end_s)[0][2] for seed in range(3)]
        for barometer in (True, False)
    )
    assert np.abs(aided_m).max() < 0.7
    assert np.abs(aided_m).max() < 0.5 * np.abs(unaided_m).max()


def climbing(t_s: float) -> Array:
    """Place in NED, metres: 3 m/s up."""
    return np.array([0.0, 0.0, -20.0 - 3.0 * t_s])


def test_a_barometer_that_appears_in_the_air_tells_of_the_climb_alone() -> None:
    """Its zero is that of the height at its own time, and as uncertain as this."""
    flown, unaided = Flown(climbing, 2, 8.0), Flown(climbing, 2, 8.0)
    for t_s in np.arange(AIDED_S + 5.0, AIDED_S + 6.0, 0.2).tolist():
        height_m = 300.0 - climbing(t_s)[2]
        flown.navigation.aid(AidedHeight(round(t_s * 1e9), height_m))
    (place, _, sigma_m, _), (without, _, sigma_without_m, _) = (
        each.error(AIDED_S + 6.0) for each in (flown, unaided)
    )
    assert flown.navigation.n_refused == {}
    assert np.abs(place - without).max() < 0.1, "nothing is known yet of where it is"
    assert sigma_m > 0.95 * sigma_without_m
