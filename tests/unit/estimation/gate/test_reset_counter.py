"""Reset counter sent to an autopilot, and identification of its boots."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest

from companion.estimation.gate.reset_counter import (
    BootIdentity,
    ResetCounter,
    initial_counter,
    same_boot,
)

NOTED = BootIdentity(1, 60.0, 1000.0, 1_795_000_000.0, "this")


def test_discontinuities_before_the_first_pose_are_not_counted() -> None:
    counter = ResetCounter()
    counter.discontinuity()
    assert counter.value == 0
    counter.sent = True
    counter.discontinuity()
    counter.discontinuity()
    assert counter.value == 2


def test_counter_continues_from_what_was_sent_or_starts_at_0() -> None:
    counter = ResetCounter()
    counter.booted(7)
    assert (counter.value, counter.sent) == (8, True)
    counter.booted(None)
    assert (counter.value, counter.sent) == (0, False)


@pytest.mark.parametrize(
    ("changes", "same"),
    [
        ({}, True),
        ({"system_id": 2}, False),
        # its clock stands lower than before: it has begun anew
        ({"autopilot_s": 57.0}, False),
        ({"autopilot_s": 59.0}, True),
        # the daemon alone was started again, an hour later; clocks drift
        ({"autopilot_s": 3660.0, "monotonic_s": 1000.4, "unix_s": 1_795_000_000.4}, True),
        ({"autopilot_s": 3660.0, "monotonic_s": 1060.0}, True),
        # what a link gives out first was piled up for some seconds
        ({"autopilot_s": 65.0, "monotonic_s": 1004.0}, True),
        # the autopilot was switched on again after 70 s, and has run for longer than before
        ({"autopilot_s": 80.0, "monotonic_s": 1070.0}, False),
        # the date was set meanwhile
        ({"autopilot_s": 80.0, "unix_s": 1_800_000_000.0}, True),
        # both computers: this one's date lags by the time it was off, or counts another day
        ({"computer": "next", "autopilot_s": 90.0, "monotonic_s": -70.0,
          "unix_s": 1_794_999_970.0}, True),
        ({"computer": "next", "autopilot_s": 90.0, "unix_s": 1_795_086_400.0}, False),
        ({"computer": "next", "autopilot_s": 20.0}, False),
        # a system that names none of its boots
        ({"computer": "", "autopilot_s": 90.0, "monotonic_s": 5.0}, True),
    ],
)  # fmt: skip
def test_same_boot(changes: dict[str, Any], same: bool) -> None:
    assert same_boot(NOTED, replace(NOTED, **changes)) is same


def test_initial_counter_is_never_0_and_varies() -> None:
    found = [initial_counter(1_795_000_000.0 + second) for second in range(600)]
    assert min(found) == 1 and max(found) == 255
    assert all(a != b for a, b in pairwise(found))
