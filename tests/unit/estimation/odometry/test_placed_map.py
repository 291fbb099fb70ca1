"""Start in a map whose scale is learnt better later: the way since its first view is, too."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.body.body_state import Reckoned
from companion.estimation.body.reckoned_path import BodyPlace
from companion.estimation.inertial.inertial_motion import InertialStart
from companion.estimation.odometry.flown_map import FlownMap, LastPose
from companion.estimation.odometry.odometry_frame import MapView, OdometryFrame
from companion.estimation.odometry.placed_map import PlacedMap, frame_of
from companion.geometry.transforms import Pose, Similarity
from companion.messages import Georeference

UP_4 = Pose(np.eye(3), np.array([0.0, 0.0, -4.0]))
"""Above the first view, in a map of metres."""
START = InertialStart(0, np.zeros(3), np.zeros(3), np.eye(6))


def georeference(scale: float, sigma_scale: float) -> Georeference:
    similarity = Similarity(scale, np.eye(3), np.zeros(3))
    return Georeference(similarity, sigma_scale, 0.1, "accelerometers", 9, 0.0, has_origin=False)


def climbed(sigma_nav_m: float) -> FlownMap:
    """Flown on after 4 m of climb, which the map has as 3.6 and navigation as 3.7 m."""
    flown = FlownMap(Pose.identity())
    placed = PlacedMap(0, georeference(0.9, 0.1), Pose.identity())
    reckoned = Reckoned(np.array([0.0, 0.0, -3.7]), np.zeros(3), sigma_nav_m, 0.1, START)
    start = frame_of(
        placed, UP_4, MapView(0, Pose.identity()), OdometryFrame(),
        BodyPlace(0, np.zeros(3), START, np.eye(3), 0.0), reckoned, None, 2.0,
    )  # fmt: skip
    assert start.goes_on
    flown.begin(placed, start, UP_4)
    flown.last = LastPose(0, UP_4, flown.frame.from_world @ placed.world_from_body(UP_4), 0.01)
    np.testing.assert_allclose(flown.last.place_m, reckoned.place_m)
    return flown


@pytest.mark.parametrize(("sigma_nav_m", "up_m"), [(1.0, 4.0), (0.01, 3.7)])
def test_a_better_scale_tells_the_climb_before_as_far_as_navigation_did_not(
    sigma_nav_m: float, up_m: float
) -> None:
    flown = climbed(sigma_nav_m)
    assert flown.georeferenced(georeference(1.0, 0.01)) == pytest.approx(1.0 / 0.9)
    assert flown.placed is not None
    body = flown.placed.world_from_body(UP_4)
    np.testing.assert_allclose(flown.frame.from_world.apply(body.translation)[2], -3.7)
    for _ in range(100):
        flown.frame = flown.frame.slewed(body, 0.1)
    assert flown.frame.from_world.apply(body.translation)[2] == pytest.approx(-up_m, abs=0.02)
