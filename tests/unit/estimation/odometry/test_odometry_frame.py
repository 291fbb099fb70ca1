"""Frame of the odometry: what is slewed away, and what stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from companion.estimation.odometry.odometry_frame import MAX_WITHIN_M, OdometryFrame, drift_m
from companion.geometry.transforms import Array, Pose, yaw_angle, yaw_rotation

BODY = Pose(yaw_rotation(0.7), np.array([30.0, -20.0, -8.0]))
DT_S = 0.1


def later(frame: OdometryFrame, body: Pose, within_m: float = 0.0) -> OdometryFrame:
    """Two minutes later, the body there by the world all the time; no step is too large."""
    for _ in range(round(120.0 / DT_S)):
        after = frame.slewed(body, DT_S, within_m)
        assert np.linalg.norm(place(after, body) - place(frame, body)) < 0.15 * DT_S + 1e-9
        frame = after
    return frame


def place(frame: OdometryFrame, body: Pose) -> Array:
    return frame.from_world.apply(body.translation)


@pytest.mark.parametrize("anchored", [False, True])
def test_known_ground_has_the_same_coordinates_after_a_loop(anchored: bool) -> None:
    """A loop that closes moves the map about the body, and it is where it began that is right."""
    begun = OdometryFrame(anchored=anchored)
    placed = begun.from_world @ BODY
    drifted = Pose(yaw_rotation(-0.04), np.array([0.5, -0.3, 0.2])) @ BODY
    after = begun.corrected(placed, drifted)
    np.testing.assert_allclose(place(after, drifted), placed.translation, atol=1e-9)
    assert abs(after.yaw_rad) > 0.03
    settled = later(after, drifted)
    np.testing.assert_allclose(place(settled, drifted), drifted.translation, atol=1e-6)
    assert settled.yaw_rad == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(
        settled.slewed_m, drifted.translation - placed.translation, atol=1e-6
    )


@pytest.mark.parametrize(
    ("anchored", "moved_m", "within_m", "left_m"),
    [
        (False, 5.0, 0.5, 5.0),
        (True, 0.4, 0.5, 0.4),
        (True, 5.0, 0.5, 0.5),
        (True, 5.0, 0.02, 0.02),
        (True, 5.0, 3.0, MAX_WITHIN_M),
    ],
)
def test_another_place_in_the_world_moves_nothing_that_satellites_cannot_tell(
    anchored: bool, moved_m: float, within_m: float, left_m: float
) -> None:
    begun = OdometryFrame(anchored=anchored)
    placed = begun.from_world @ BODY
    elsewhere = Pose(yaw_rotation(0.02), np.array([0.0, moved_m, 0.0])) @ BODY
    elsewhere = replace(elsewhere, translation=BODY.translation + [0.0, moved_m, 0.0])
    after = later(begun.holding(placed, elsewhere), elsewhere, within_m)
    off_m = float(np.linalg.norm(place(after, elsewhere) - elsewhere.translation))
    assert off_m == pytest.approx(left_m, abs=1e-6)
    assert after.yaw_rad == pytest.approx(0.0 if anchored else -0.02, abs=1e-6)


def test_what_is_owed_outlasts_another_place_in_the_world() -> None:
    begun = OdometryFrame()
    owes = begun.shifted(np.array([0.4, 0.0, 0.0]))
    placed = owes.from_world @ BODY
    elsewhere = Pose(np.eye(3), np.array([0.0, 9.0, 0.0])) @ BODY
    after = later(owes.holding(placed, elsewhere), elsewhere)
    np.testing.assert_allclose(place(after, elsewhere), BODY.translation, atol=1e-6)


def test_a_turn_about_a_place_turns_what_is_owed() -> None:
    about_m, turn_rad = np.array([28.0, -20.0, 0.0]), 0.3
    owes = OdometryFrame().shifted(np.array([0.0, 0.6, 0.0]))
    turned = owes.turned(about_m, turn_rad, place(owes, BODY))
    assert turned.yaw_rad == pytest.approx(turn_rad)
    np.testing.assert_allclose(turned.slewed_m, place(turned, BODY) - place(owes, BODY), atol=1e-9)
    wanted_m = about_m + yaw_rotation(turn_rad) @ (BODY.translation - about_m)
    settled = later(turned, BODY)
    np.testing.assert_allclose(place(settled, BODY), wanted_m, atol=1e-6)
    assert yaw_angle(settled.from_world.rotation) == pytest.approx(turn_rad)


@pytest.mark.parametrize("span_s", [2.0, 10.0, 60.0, 1000.0])
def test_satellites_that_drift_scatter_less_in_a_short_time_than_they_are_off(
    span_s: float,
) -> None:
    """Over 400 ways of an error of one metre that lasts for 40 s."""
    rng, dt_s = np.random.default_rng(1), span_s / 100
    held = np.exp(-dt_s / 40.0)
    off = np.empty((100, 400))
    off[0] = rng.normal(size=400)
    for k in range(1, 100):
        off[k] = held * off[k - 1] + np.sqrt(1.0 - held**2) * rng.normal(size=400)
    residual_m = float(np.sqrt(off.var(axis=0).mean()))
    assert drift_m(residual_m, span_s) == pytest.approx(1.0, abs=0.1)
