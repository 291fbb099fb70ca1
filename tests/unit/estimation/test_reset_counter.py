"""Which reset counter an autopilot is sent, and which of its boots are seen as the same."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest

from companion.estimation.reset_counter import BootIdentity, ResetCounter, same_boot, unlike_any

NOTED = BootIdentity(1, 60.0, 1000.0, 1_795_000_000.0, "this")


def test_nothing_counts_before_the_first_pose() -> None:
    counter = ResetCounter()
    counter.discontinuity()
    assert counter.value == 0
    counter.sent = True
    counter.discontinuity()
    counter.discontinuity()
    assert counter.value == 2


def test_a_boot_goes_on_from_what_it_was_sent_or_begins_at_0() -> None:
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


def test_what_stands_for_the_unknown_is_never_0_and_differs_from_second_to_second() -> None:
    found = [unlike_any(1_795_000_000.0 + second) for second in range(600)]
    assert min(found) == 1 and max(found) == 255
    assert all(a != b for a, b in pairwise(found))
