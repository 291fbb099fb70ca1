"""Optical flow aids inertial navigation on the ground: what sees nothing move has not moved."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.body.body_filter import BodyFilter
from companion.estimation.inertial.acceleration_integral import AccelerationIntegral
from companion.estimation.lift_off.ground_aiding import LEGS_M, LOW_M, GroundAiding
from companion.estimation.lift_off.optical_flow import GroundVelocity
from companion.geometry.transforms import Array
from companion.telemetry import AttitudeSample, ImuSample

STEP_NS, IMU_STEP_NS = 50_000_000, 10_000_000
STOOD_M = np.array([2.0, 1.0, -0.5])
G_M_S2 = 9.80665
TILTED_RAD = np.radians(2.0)


class Vehicle:
    """One that stands for two seconds; afterwards its stand is not known to last."""

    def __init__(self) -> None:
        self._integral = AccelerationIntegral()
        self.navigation = BodyFilter(self._integral)
        self.ground = GroundAiding(self.navigation)
        self.t_ns, self.contradicted = 0, False
        for _ in range(40):
            self._measure(np.zeros(3), 0.0)
            self.ground.stand(self.t_ns, STOOD_M)

    def go_on(
        self, seconds: float, accelerates_m_s2: Array, tilted_rad: float, flow_hz: Array | None,
        range_m: float | None = None, upright: float | None = 1.0,
    ) -> None:  # fmt: skip
        """By its own measurements; its autopilot's pitch is wrong by `tilted_rad`."""
        for _ in range(round(seconds * 1e9 / STEP_NS)):
            self._measure(accelerates_m_s2, tilted_rad)
            self.ground.fly(self.t_ns, float(self.place_m[2]), True, upright)
            if range_m is not None:
                self.ground.take_range(self.t_ns, range_m)
            if flow_hz is not None:
                seen = GroundVelocity(self.t_ns - STEP_NS // 2, flow_hz, 0.01**2 * np.eye(3))
                self.contradicted |= self.ground.take_flow(seen, 0)

    @property
    def place_m(self) -> Array:
        found = self.navigation.at(self.t_ns)
        assert found is not None
        return found.place_m

    @property
    def bias_m_s2(self) -> Array:
        found = self.navigation.at(self.t_ns)
        assert found is not None
        return found.start.bias_body_m_s2

    @property
    def velocity_m_s(self) -> Array:
        found = self.navigation.at(self.t_ns)
        assert found is not None
        return found.velocity_m_s

    def land(self, flow_hz: Array | None) -> None:
        """Up for two seconds over ground that it sees sink, down for two, and 10 s on the ground.

        Its accelerometers have measured half of the blow: it goes on at half a metre a second.
        """
        for up_m_s2 in (1.0, -1.0, -1.0, 0.5):
            for _ in range(20):
                down_m_s = float(self.velocity_m_s[2]) - 0.5 * up_m_s2 * STEP_NS * 1e-9
                height_m = max(STOOD_M[2] + LEGS_M - float(self.place_m[2]), LEGS_M)
                sinking_hz = np.array([0.0, 0.0, down_m_s / height_m])
                self.go_on(STEP_NS * 1e-9, np.array([0.0, 0.0, -up_m_s2]), 0.0, sinking_hz)
        self.go_on(10.0, np.zeros(3), 0.0, flow_hz)

    def _measure(self, accelerates_m_s2: Array, tilted_rad: float) -> None:
        for _ in range(STEP_NS // IMU_STEP_NS):
            self.t_ns += IMU_STEP_NS
            force = accelerates_m_s2 - np.array([0.0, 0.0, G_M_S2])
            half = 0.5 * tilted_rad
            said = np.array([np.cos(half), 0.0, np.sin(half), 0.0])
            self._integral.take(ImuSample(self.t_ns, np.zeros(3), force))
            self._integral.take(AttitudeSample(self.t_ns, said))


def test_a_vehicle_that_rocks_on_its_gear_does_not_move_nor_is_its_mount_wrong() -> None:
    """PX4's attitude is wrong by two degrees as its motors start, and its stand ends.

    They shake its accelerometers, too, which show it sink.
    """
    unaided, aided, sinks_m_s2 = Vehicle(), Vehicle(), np.array([0.0, 0.0, 0.1])
    unaided.go_on(2.5, sinks_m_s2, TILTED_RAD, None)
    aided.go_on(2.5, sinks_m_s2, TILTED_RAD, np.array([0.02, -0.07, 0.01]))
    assert np.linalg.norm(unaided.velocity_m_s[:2]) > 0.7 and unaided.velocity_m_s[2] > 0.2
    assert np.linalg.norm(aided.velocity_m_s) < 0.13
    assert np.linalg.norm(aided.place_m - STOOD_M) < 0.12
    assert not aided.contradicted and aided.ground.lift_off_flow.agrees is None


def test_a_picture_in_which_nothing_moves_holds_no_vehicle_that_has_risen() -> None:
    """A camera that sees nothing but its own vehicle."""
    vehicle = Vehicle()
    up_and_north = np.array([0.5, 0.0, -2.0])
    vehicle.go_on(2.0, up_and_north, 0.0, np.zeros(3))
    assert STOOD_M[2] - vehicle.place_m[2] > 10.0 * LEGS_M
    assert vehicle.velocity_m_s[0] > 0.5 * (2.0 - 0.7)


def test_no_map_begins_until_a_vehicle_has_risen_a_metre_or_hovers_lower() -> None:
    climbs, hovers, unknown = Vehicle(), Vehicle(), Vehicle()
    assert not climbs.ground.low
    for _ in range(29):
        climbs.go_on(0.1, np.array([0.0, 0.0, -1.0]), 0.0, None)
        hovers.go_on(0.1, np.zeros(3), 0.0, np.zeros(3))
        assert climbs.ground.low == (STOOD_M[2] - climbs.place_m[2] < LOW_M)
        assert hovers.ground.low
    hovers.go_on(0.2, np.zeros(3), 0.0, np.zeros(3))
    assert not hovers.ground.low
    unknown.navigation.reset()
    unknown.ground.fly(unknown.t_ns + STEP_NS, float(STOOD_M[2]), True, 1.0)
    assert not unknown.ground.low


def test_a_vehicle_that_has_touched_down_sinks_no_further() -> None:
    """Its map is lost there, and a picture in which nothing moves shows that it is at rest."""
    unaided, aided = Vehicle(), Vehicle()
    unaided.land(None)
    aided.land(np.array([0.005, -0.01, 0.0]))
    assert unaided.place_m[2] - STOOD_M[2] > 3.0 and unaided.velocity_m_s[2] > 0.3
    assert np.linalg.norm(aided.velocity_m_s) < 0.02
    assert aided.place_m[2] - STOOD_M[2] < 0.6
    assert np.abs(aided.bias_m_s2).max() < 0.01


def test_a_rangefinder_tells_the_height_of_a_climb() -> None:
    """Its accelerometers measure 0.3 m/s2 too much."""
    unaided, aided = Vehicle(), Vehicle()
    for k in range(80):
        measured_m_s2 = np.array([0.0, 0.0, -0.3 - (1.0 if k < 20 else 0.0)])
        seconds = (k + 1) * STEP_NS * 1e-9
        risen_m = 0.5 * min(seconds, 1.0) ** 2 + max(seconds - 1.0, 0.0)
        unaided.go_on(STEP_NS * 1e-9, measured_m_s2, 0.0, None)
        aided.go_on(STEP_NS * 1e-9, measured_m_s2, 0.0, None, LEGS_M + risen_m)
    assert STOOD_M[2] - unaided.place_m[2] - risen_m > 1.5
    assert abs(STOOD_M[2] - aided.place_m[2] - risen_m) < 0.4


def test_heights_and_ranges_newer_than_a_frame_take_its_pose_from_it_at_no_time() -> None:
    """In flight telemetry up to now comes with a frame that was exposed 60 ms ago."""
    vehicle, exposed_ns = Vehicle(), 60_000_000
    vehicle.go_on(3.0, np.array([0.0, 0.0, -1.0]), 0.0, None)
    for _ in range(40):
        vehicle.go_on(STEP_NS * 1e-9, np.zeros(3), 0.0, None)
        vehicle.ground.take_height(vehicle.t_ns, 4.5, True)
        vehicle.ground.take_range(vehicle.t_ns, 4.7)
        assert vehicle.navigation.at(vehicle.t_ns - exposed_ns) is not None
        assert vehicle.navigation.at(vehicle.t_ns - exposed_ns - STEP_NS // 2) is not None
    assert vehicle.navigation.over_ground()[1] < 0.15  # they did aid


@pytest.mark.parametrize("upright", [None, -1.0, 0.3])
def test_a_range_of_a_body_whose_tilt_is_unknown_or_that_lies_on_its_side_says_no_height(
    upright: float | None,
) -> None:
    """Taken as upright, or as none at all, it would move the body: it sees 1 m more, or 0 m."""
    unaided, aided = Vehicle(), Vehicle()
    for _ in range(40):
        climbs_m_s2 = np.array([0.0, 0.0, -1.0])
        height_m = STOOD_M[2] + LEGS_M - float(aided.place_m[2])
        unaided.go_on(STEP_NS * 1e-9, climbs_m_s2, 0.0, None)
        aided.go_on(STEP_NS * 1e-9, climbs_m_s2, 0.0, None, height_m + 0.2, upright)
    assert np.array_equal(aided.place_m, unaided.place_m)
    aided.go_on(STEP_NS * 1e-9, climbs_m_s2, 0.0, None, height_m + 0.2)
    aided.go_on(0.5, climbs_m_s2, 0.0, None, height_m + 0.2)
    unaided.go_on(0.5 + STEP_NS * 1e-9, climbs_m_s2, 0.0, None)
    assert not np.array_equal(aided.place_m, unaided.place_m)


def test_ranges_after_the_last_frame_are_of_no_use_nor_kept() -> None:
    vehicle = Vehicle()
    vehicle.go_on(1.0, np.array([0.0, 0.0, -1.0]), 0.0, None)
    for k in range(1000):
        vehicle.ground.take_range(vehicle.t_ns + k * 100_000_000, 0.7)
        vehicle.ground.take_height(vehicle.t_ns + k * 200_000_000, 0.7, True)
    assert len(vehicle.ground._late) <= 6
