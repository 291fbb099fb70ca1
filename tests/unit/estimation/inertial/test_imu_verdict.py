"""Verdict on the IMU: each way to be wrong is found and said, and no right one is refused."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from companion.estimation.inertial.acceleration_integral import (
    GRAVITY_NED_M_S2,
    AccelerationIntegral,
)
from companion.estimation.inertial.imu_verdict import NOT_USED, USED_AGAIN, Change, ImuVerdict
from companion.estimation.inertial.judged_acceleration import ByAcceleration, JudgedAcceleration
from companion.geometry.transforms import (
    Array,
    Similarity,
    quaternion_from_euler,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    vector_from_rotation,
)
from companion.messages import Georeference, Warned
from companion.telemetry import AttitudeSample, ImuSample

Sample = AttitudeSample | ImuSample
Motion = Callable[[float], tuple[Array, Array]]
"""Acceleration in NED, m/s2, and roll, pitch and yaw, rad, by the time in seconds."""
G = 9.80665
QUARTER = np.pi / 2
SECONDS = 15.0


def hovering(t_s: float) -> tuple[Array, Array]:
    return np.zeros(3), np.array([0.01, -0.02, 0.3])


def swaying(t_s: float) -> tuple[Array, Array]:
    """Hovering in wind, with the corrections that hold its place."""
    roll, pitch = 0.03 * np.sin(3.1 * t_s), 0.02 * np.sin(2.3 * t_s + 1.0)
    yaw = 0.02 * np.sin(1.1 * t_s)
    return np.array([-G * pitch, G * roll, 0.0]), np.array([roll, pitch, yaw])


def straight(t_s: float) -> tuple[Array, Array]:
    return np.zeros(3), np.array([0.0, -0.12, 1.0])


def circling(t_s: float) -> tuple[Array, Array]:
    """8 m/s at 0.4 rad/s, banked so that its seat is its floor."""
    yaw = 0.4 * t_s
    inwards = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    return 3.2 * inwards, np.array([np.arctan2(3.2, G), 0.0, yaw])


def weaving(t_s: float) -> tuple[Array, Array]:
    """Turns, climbs and brakes."""
    roll, pitch = 0.25 * np.sin(0.9 * t_s), 0.15 * np.sin(1.7 * t_s) - 0.05
    acceleration = np.array([-3.0 * pitch, G * np.tan(roll), 1.5 * np.sin(0.6 * t_s)])
    return acceleration, np.array([roll, pitch, 0.6 * np.sin(0.5 * t_s)])


def attitude(motion: Motion, t_s: float) -> Array:
    return quaternion_from_euler(*motion(t_s)[1])


def made_up(
    motion: Motion, *, seed: int = 0, imu_hz: int = 100, attitude_hz: int = 50,
    shaken_m_s2: float = 0.0, seconds: float = SECONDS, noise: float = 1.0,
) -> Iterator[Sample]:  # fmt: skip
    """What an autopilot states of a motion, in order of time: noise, bias, and steps."""
    rng = np.random.default_rng(seed)
    bias_accel, bias_gyro = rng.normal(scale=0.06, size=3), rng.normal(scale=0.004, size=3)
    for i in range(round(1000 * seconds)):
        t_s = i * 1e-3
        if i % (1000 // attitude_hz) == 0:
            yield AttitudeSample(i * 1_000_000, attitude(motion, t_s))
        if i % (1000 // imu_hz) == 0:
            body = rotation_from_quaternion(attitude(motion, t_s))
            after = rotation_from_quaternion(attitude(motion, t_s + 1e-3))
            rate = vector_from_rotation(body.T @ after) * 1e3 + bias_gyro
            force = body.T @ (motion(t_s)[0] - GRAVITY_NED_M_S2) + bias_accel
            rate += noise * rng.normal(scale=0.004, size=3)
            force += rng.normal(scale=np.hypot(0.08 * noise, shaken_m_s2), size=3)
            step = 1e-3 * G
            yield ImuSample(
                i * 1_000_000, np.round(rate, 3), np.round(force / step) * step
            )  # fmt: skip


@lru_cache(maxsize=4)
def _kept(motion: Motion, **options: float) -> tuple[Sample, ...]:
    return tuple(made_up(motion, **options))  # type: ignore[arg-type]


def samples(motion: Motion, **options: float) -> Iterator[Sample]:
    """The same, made up once only."""
    return iter(_kept(motion, **options))


Wrong = Callable[[ImuSample], ImuSample | None]


def altered(right: Iterator[Sample], wrong: Wrong) -> Iterator[Sample]:
    every = [wrong(each) if isinstance(each, ImuSample) else each for each in right]
    yield from sorted((each for each in every if each is not None), key=lambda each: each.t_ns)


def judged(given: Iterator[Sample]) -> tuple[ImuVerdict, list[Change], bool]:
    """The verdict after all samples, its changes, and whether it ever believed them."""
    verdict, changes, believed = ImuVerdict(), [], False
    for each in given:
        change = verdict.take(each)
        believed |= verdict.believed
        if change is not None:
            changes.append(change)
    return verdict, changes, believed


def turned(by: Array) -> Wrong:
    return lambda each: ImuSample(each.t_ns, by @ each.gyro_rad_s, by @ each.accel_m_s2)


def about(axis: int, quarters: int = 1) -> Wrong:
    return turned(rotation_from_vector(quarters * QUARTER * np.eye(3)[axis]))


def late(seconds: float) -> Wrong:
    def wrong(each: ImuSample) -> ImuSample:
        return ImuSample(each.t_ns + round(seconds * 1e9), each.gyro_rad_s, each.accel_m_s2)

    return wrong


def forces(of: Callable[[Array], Array]) -> Wrong:
    return lambda each: ImuSample(each.t_ns, each.gyro_rad_s, of(each.accel_m_s2))


def lifting_off(t_s: float) -> tuple[Array, Array]:
    """Standing for 12 s, then swaying."""
    acceleration, angles = swaying(max(t_s - 12.0, 0.0))
    standing = swaying(0.0)[1]
    return (np.zeros(3), standing) if t_s < 12.0 else (acceleration, angles)


@pytest.mark.parametrize("motion", [hovering, swaying, straight, circling, weaving])
@pytest.mark.parametrize(
    ("imu_hz", "attitude_hz", "shaken_m_s2"), [(100, 50, 0.0), (50, 20, 0.5), (100, 100, 0.5)]
)
def test_a_right_one_is_never_refused(
    motion: Motion, imu_hz: int, attitude_hz: int, shaken_m_s2: float
) -> None:
    given = samples(
        motion, seed=imu_hz + attitude_hz, imu_hz=imu_hz, attitude_hz=attitude_hz,
        shaken_m_s2=shaken_m_s2,
    )  # fmt: skip
    verdict, changes, _ = judged(given)
    assert changes == []
    assert verdict.believed


def rough(given: Iterator[Sample], seed: int, sigma_rad: float = np.radians(0.1)) -> list[Sample]:
    """Attitudes with white noise, as of a link that rounds them."""
    rng = np.random.default_rng(seed)

    def turned_a_little(each: AttitudeSample) -> AttitudeSample:
        rotation = rotation_from_quaternion(each.ned_from_body)
        off = rotation_from_vector(rng.normal(scale=sigma_rad, size=3))
        return replace(each, ned_from_body=quaternion_from_rotation(rotation @ off))

    return [turned_a_little(e) if isinstance(e, AttitudeSample) else e for e in given]


@pytest.mark.parametrize("motion", [hovering, swaying, straight, circling, weaving])
@pytest.mark.parametrize("attitude_hz", [20, 50, 100])
def test_noise_of_the_attitude_is_not_the_imu(motion: Motion, attitude_hz: int) -> None:
    """At 25 Hz a tenth of a degree looks like turns of 3.5 degrees/s that no gyroscope measures."""
    given = samples(motion, attitude_hz=attitude_hz, seconds=16.0)
    verdict, changes, _ = judged(iter(rough(given, attitude_hz)))
    assert changes == []
    assert verdict.believed


MIXED = np.array([0.3, -2.0, 0.5])


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (about(2), "turned by 90 degrees about -z"),
        (late(0.3), "ms late"),
        (lambda each: replace(each, gyro_rad_s=each.gyro_rad_s[[1, 2, 0]] * MIXED), "its "),
    ],
)  # fmt: skip
def test_noise_of_the_attitude_hides_no_wrong_imu(wrong: Wrong, words: str) -> None:
    _, changes, believed = judged(iter(rough(altered(samples(weaving), wrong), 1)))
    assert changes and words in changes[0].warning.detail
    assert not believed


@pytest.mark.parametrize("motion", [swaying, weaving])
def test_turns_of_the_body_confirm_it_within_four_seconds(motion: Motion) -> None:
    verdict, _, _ = judged(samples(motion, seconds=4.0))
    assert verdict.confirmed


@pytest.mark.parametrize("motion", [hovering, straight])
def test_without_turns_it_takes_longer(motion: Motion) -> None:
    """Nothing shows how the axes lie, and nothing goes wrong by it."""
    verdict, _, believed = judged(samples(motion, seconds=8.0))
    assert not verdict.confirmed
    assert not believed
    assert judged(samples(motion))[0].believed


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (about(0), "turned by 90 degrees about -x"),
        (about(1), "turned by 90 degrees about -y"),
        (about(2), "turned by 90 degrees about -z"),
        (about(2, -1), "turned by 90 degrees about z"),
        (about(2, 2), "turned by 180 degrees about z"),
        (turned(np.diag([1.0, -1.0, -1.0])), "forward, left and up"),
        (turned(np.diag([-1.0, 1.0, 1.0])), "its x axis points the other way"),
        (turned(np.diag([1.0, -1.0, 1.0])), "its y axis points the other way"),
        (turned(np.diag([1.0, 1.0, -1.0])), "its z axis points the other way"),
        (late(0.1), "it is 100 ms late"),
        (late(0.3), "it is 300 ms late"),
        (late(1.0), "it is 1000 ms late"),
        (late(-0.2), "it is 200 ms early"),
        (forces(lambda force: force / G), "in g, not in m/s2"),
        (forces(lambda force: force[[1, 2, 0]]), "its axes are not those of the body"),
        (forces(lambda force: 0.0 * force), "it is stuck"),
        (forces(lambda force: np.array([0.0, 0.0, -G])), "it is stuck"),
        (forces(lambda force: 1.6 * force), "do not agree with gravity"),
        (lambda each: each if each.t_ns % 100_000_000 == 0 else None, "it comes at 10 Hz"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_and_nothing_believed_before(wrong: Wrong, words: str) -> None:
    verdict, changes, believed = judged(altered(samples(weaving), wrong))
    assert [each.warning.what for each in changes] == [NOT_USED]
    assert words in changes[0].warning.detail == verdict.fault
    assert changes[0].invalid_since_ns is not None and changes[0].invalid_since_ns < 0
    assert not believed


@pytest.mark.parametrize("range_g", [2.0, 4.0])
def test_the_end_of_the_range_is_found_and_its_vibration_alone_is_not(range_g: float) -> None:
    def clipped(force: Array) -> Array:
        return np.clip(force, -range_g * G, range_g * G)

    strong = range_g * 4.0
    _, changes, _ = judged(altered(samples(weaving, shaken_m_s2=strong), forces(clipped)))
    assert "it is saturated: its z axis ends at" in changes[0].warning.detail
    assert judged(samples(weaving, shaken_m_s2=strong))[1] == []


def test_a_stuck_axis_is_found_before_long_and_all_since_is_withdrawn() -> None:
    since_ns = 10_000_000_000

    def wrong(each: ImuSample) -> ImuSample:
        if each.t_ns < since_ns:
            return each
        return ImuSample(each.t_ns, each.gyro_rad_s, np.array([0.4, *each.accel_m_s2[1:]]))

    _, (change,), _ = judged(altered(samples(weaving), wrong))
    assert "its x axis stays at +0.4 m/s2" in change.warning.detail
    assert change.warning.t_ns < since_ns + 4_500_000_000
    assert change.invalid_since_ns is not None and 0 < change.invalid_since_ns < since_ns


def test_one_that_falls_silent_is_used_again_when_it_is_back() -> None:
    def wrong(each: ImuSample) -> ImuSample | None:
        return None if 8.0 < each.t_ns * 1e-9 < 12.0 else each

    verdict, (silent, back), _ = judged(altered(samples(weaving, seconds=24.0), wrong))
    assert silent.warning.detail == "it is silent"
    assert 9.0 <= silent.warning.t_ns * 1e-9 <= 10.5
    assert silent.invalid_since_ns is None, "what came before was right"
    assert back.warning.what == USED_AGAIN and back.warning.good
    assert back.warning.t_ns * 1e-9 > 16.0
    assert verdict.believed


@pytest.mark.parametrize("seconds", [2.0, 5.0])
@pytest.mark.parametrize("motion", [hovering, weaving])
def test_a_link_that_is_cut_is_not_the_imu(motion: Motion, seconds: float) -> None:
    """Used again at once: dead reckoning is wanted most where links fail."""

    def heard(each: Sample) -> bool:
        return not 12.0 < each.t_ns * 1e-9 < 12.0 + seconds

    given = samples(motion, seconds=22.0 + seconds)
    verdict, changes, _ = judged(each for each in given if heard(each))
    assert (changes, verdict.believed) == ([], True)


def test_one_that_stays_away_after_a_cut_is_said() -> None:
    def heard(each: Sample) -> bool:
        t_s = each.t_ns * 1e-9
        return t_s < 8.0 if isinstance(each, ImuSample) else not 8.0 < t_s < 11.0

    given = samples(weaving, seconds=16.0)
    verdict, (silent,), _ = judged(each for each in given if heard(each))
    assert silent.warning.detail == verdict.fault == "it is silent"
    assert 12.0 <= silent.warning.t_ns * 1e-9 <= 13.5


def test_axes_that_are_right_again_must_show_it() -> None:
    def wrong(each: ImuSample) -> ImuSample | None:
        return about(2)(each) if each.t_ns < 6_000_000_000 else each

    verdict, changes, _ = judged(altered(samples(weaving, seconds=26.0), wrong))
    assert [each.warning.good for each in changes] == [False, True]
    assert verdict.confirmed


def test_one_that_never_comes_is_not_spoken_of() -> None:
    verdict, changes, believed = judged(altered(samples(weaving), lambda _: None))
    assert (changes, believed, verdict.fault) == ([], False, "")


def test_a_heading_that_jumps_is_not_the_imu() -> None:
    """The autopilot's filter corrects its heading in flight."""

    jumped = misheaded(samples(weaving), lambda t_s: 0.3 * (t_s > 9.0))
    assert judged(jumped)[1] == []


def misheaded(given: Iterator[Sample], error_rad: Callable[[float], float]) -> Iterator[Sample]:
    """With an attitude whose heading is off."""
    for each in given:
        if isinstance(each, AttitudeSample):
            yaw = quaternion_from_euler(0.0, 0.0, error_rad(each.t_ns * 1e-9))
            w, x, y, z = each.ned_from_body
            a, d = yaw[0], yaw[3]
            turned_by = np.array([a * w - d * z, a * x - d * y, a * y + d * x, a * z + d * w])
            yield AttitudeSample(each.t_ns, turned_by)
        else:
            yield each


ALIGNED_S = 9.0 + np.array([0.0, 0.1, 0.5, 1.0, 1.7, 2.1, 2.6, 3.1, 4.0, 5.0])
HEADING_DEG = np.array([0.4, 0.5, 0.7, 1.5, -2.9, -8.3, -7.1, -2.7, 1.0, 2.6])
AHEAD_S = 0.1
"""As ArduCopter (4.7-dev, in its simulator) swung while it aligned its heading anew on the way up:
its attitude was ahead of its gyroscopes, about the vertical."""


@pytest.mark.parametrize("late_s", [0.0, 0.2])
def test_a_heading_that_is_aligned_anew_is_no_delay(late_s: float) -> None:
    def heading_rad(t_s: float) -> float:
        return float(np.radians(np.interp(t_s, ALIGNED_S, HEADING_DEG)))

    def motion(t_s: float) -> tuple[Array, Array]:
        acceleration, angles = swaying(t_s)
        return 0.3 * acceleration, 0.3 * angles + [0.0, 0.0, heading_rad(t_s)]

    def error_rad(t_s: float) -> float:
        return heading_rad(t_s + AHEAD_S) - heading_rad(t_s)

    given = altered(made_up(motion, seconds=20.0), late(late_s))
    changes = judged(misheaded(given, error_rad))[1]
    assert all("ms late" in change.warning.detail for change in changes)
    assert bool(changes) == (late_s > 0.0)


@pytest.mark.parametrize("period_s", [1.5, 4.0, 9.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_heading_that_swings_on_the_ground_is_not_the_imu(period_s: float, seed: int) -> None:
    """PX4 finds its heading by a disturbed compass, and swings by 14 degrees for seconds."""

    def error_rad(t_s: float) -> float:
        swing_rad = np.radians(14.0) * np.exp(-max(t_s - 10.0, 0.0) / 3.0)
        return float(swing_rad * np.sin(2.0 * np.pi * t_s / period_s))

    given = misheaded(made_up(lifting_off, seed=seed, seconds=25.0), error_rad)
    assert judged(given)[1] == []


def integrated(wrong: Wrong) -> tuple[AccelerationIntegral, list[int], list[Warned]]:
    integral, withdrawn = AccelerationIntegral(), list[int]()
    acceleration = JudgedAcceleration([integral], withdrawn.append)
    for each in altered(samples(weaving), wrong):
        acceleration.take(each)
    return integral, withdrawn, acceleration.warnings()


def test_what_is_not_allowed_is_a_gap_in_the_integral() -> None:
    integral, withdrawn, warned = integrated(about(2))
    assert len(warned) == len(withdrawn) == 1
    assert not integral.has_samples
    right, withdrawn, warned = integrated(lambda each: each)
    assert (withdrawn, warned) == ([], [])
    assert right.believed and right.between(5_000_000_000, 14_500_000_000) is not None

    def stops(each: ImuSample) -> ImuSample:
        stuck = ImuSample(each.t_ns, each.gyro_rad_s, np.array([0.1, 0.2, -9.0]))
        return each if each.t_ns < 10_000_000_000 else stuck

    integral, (since_ns,), _ = integrated(stops)
    assert integral.believed, "of what was right before"
    assert integral.between(1_000_000_000, since_ns - 100_000_000) is not None
    assert integral.between(since_ns - 200_000_000, 9_000_000_000) is None


def found(scale: float, method: str) -> Georeference:
    return Georeference(Similarity(scale, np.eye(3), np.zeros(3)), 0.01, 0.1, method, 9, 0.0)


def test_a_scale_by_wrong_accelerations_gives_way_to_the_one_before() -> None:
    noted, known = ByAcceleration(), dict[int, Georeference]()
    for t_ns, scale in ((10, 2.0), (20, 2.1), (30, 7.0), (40, 8.0)):
        now = found(scale, "accelerometers")
        noted.note(t_ns, 1, known, now)
        known[1] = now
    noted.withdraw(25, known)
    assert known[1].world_from_map.scale == 2.1
    noted.withdraw(0, known)
    assert known == {}


def test_a_scale_by_places_stays() -> None:
    noted, known = ByAcceleration(), {1: found(3.0, "GPS")}
    noted.note(10, 1, known, known[1])
    noted.withdraw(0, known)
    assert known[1].world_from_map.scale == 3.0


def test_what_a_restart_has_resumed_stays() -> None:
    """It was found before the restart, by an IMU that was right."""
    noted, known = ByAcceleration(), {1: found(3.0, "accelerometers")}
    noted.withdraw(0, known)
    assert known[1].world_from_map.scale == 3.0


def test_more_than_can_be_taken_back_is_dropped() -> None:
    noted, known = ByAcceleration(), dict[int, Georeference]()
    for t_ns in range(500):
        now = found(3.0, "accelerometers")
        noted.note(t_ns, 1, known, now)
        known[1] = now
    noted.withdraw(0, known)
    assert known == {}


@pytest.mark.parametrize("seed", range(3))
def test_a_lift_off_leaves_the_belief_as_it_was(seed: int) -> None:
    """Pose and scale go by accelerometers just then."""
    verdict, believed = ImuVerdict(), []
    for each in samples(lifting_off, seed=seed, seconds=18.0):
        verdict.take(each)
        if each.t_ns > 11_500_000_000:
            believed.append(verdict.believed)
    assert all(believed) and verdict.confirmed


def test_a_turned_one_is_not_believed_after_lift_off() -> None:
    """What cannot be seen while it stands shows with the first turns."""
    verdict, believed_ns, fault_ns = ImuVerdict(), 0, 0
    wrong = turned(rotation_from_vector(np.array([0.0, 0.0, QUARTER])))
    for each in altered(samples(lifting_off, seed=1, seconds=18.0), wrong):
        verdict.take(each)
        if verdict.believed:
            believed_ns = each.t_ns
        if verdict.fault and not fault_ns:
            fault_ns = each.t_ns
    assert 0 < believed_ns < 14_100_000_000
    assert 0 < fault_ns < 15_000_000_000
