"""A picture stands where its map stands and accelerometers go on."""

from __future__ import annotations

import numpy as np

from companion.estimation.body.body_state import Reckoned
from companion.estimation.inertial.inertial_motion import InertialStart
from companion.estimation.odometry.standing_picture import StandingPicture

STEP_NS = 50_000_000
START = InertialStart(0, np.zeros(3), np.zeros(3), np.eye(6))


def stood(seen_m: float, gone_m: float, apart_m: float = 0.0) -> bool:
    """Of a body that has gone so far since both agreed, by its map and by accelerometers.

    Where they agreed, inertial navigation was `apart_m` from the map.
    """
    picture = StandingPicture()
    for n in range(4):
        seen = np.array([seen_m * n / 3, 0.0, -8.0])
        gone = np.array([apart_m + gone_m * n / 3, 0.0, -8.0])
        reckoned = Reckoned(gone, np.zeros(3), 0.1, 0.1, START)
        stands = picture.stands(n * STEP_NS, seen, reckoned, refused=n > 0)
    assert stands == (picture.since_ns is not None)
    return stands


def test_a_map_that_stands_while_the_body_goes_on() -> None:
    assert stood(0.02, 0.4)
    assert not stood(0.02, 0.2)  # not far enough to tell
    assert not stood(0.2, 0.4)


def test_it_is_judged_by_motion_and_not_by_how_far_off_the_map_is() -> None:
    """By a rolling shutter in quick turns it is half a metre off, and moves on."""
    assert not stood(0.25, 0.25, apart_m=0.7)
    assert stood(0.02, 0.4, apart_m=-0.4)
