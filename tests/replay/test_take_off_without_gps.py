"""A drone without GPS that flies by its poses alone: stands, arms, climbs to 5 m, holds."""

from __future__ import annotations

from companion.messages import TrackState
from tests.support.flights.takeoff_loop import Times, take_off

TIMES = Times(armed_s=11.0, lift_s=12.0, held_s=19.0, end_s=21.0)
"""An IMU that does not turn is judged for ten seconds."""


def test_it_has_a_pose_before_it_is_armed_and_to_the_end() -> None:
    flown = take_off(0, times=TIMES)
    assert flown.first_s < TIMES.armed_s
    assert flown.longest_gap_s < 0.1
    assert TrackState.STANDING in flown.states
    level_m, down_m = flown.worst_pose_m
    assert level_m < 0.3
    assert down_m < 0.6
    # the scale becomes known in the hover, which makes no keyframes
    assert flown.states[-1] is TrackState.TRACKING
    assert {pose.reset_counter for pose in flown.sent} == {0}
