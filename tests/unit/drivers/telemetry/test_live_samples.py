"""What the live link counts as dropped."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.telemetry import Telemetry
from companion.timing.link_clock import ClockFilter
from drivers.telemetry.live_samples import LiveSamples

S = 10**9
START_NS = 1_700_000_000 * S


def gps(time_usec: int, fix_type: int) -> Any:
    return mavlink.MAVLink_gps_raw_int_message(
        time_usec, fix_type, -353632620, 1491652370, 584000, 65535, 65535, 0, 0, 0
    )


def taken(message: Any) -> tuple[list[Telemetry], dict[str, int]]:
    clock, given = ClockFilter(), list[Telemetry]()
    samples = LiveSamples(clock, given.append, lambda warned: None)
    for k in range(20):
        now_ns = START_NS + k * S // 5
        clock.exchange(now_ns, 80 * S + k * S // 5, now_ns)
        samples.take(message, now_ns)
    return given, dict(samples.n_dropped)


def test_an_autopilot_without_satellites_has_nothing_to_drop() -> None:
    """ArduCopter without a receiver sends GPS_RAW_INT five times a second, without a time."""
    assert taken(gps(0, 0)) == ([], {})


def test_a_fix_whose_time_is_not_known_is_dropped_and_counted() -> None:
    lost = {"telemetry without boot time": 20}
    assert taken(gps(0, 3)) == ([], lost)
    assert taken(gps(START_NS // 1000, 3)) == ([], lost)  # and no SYSTEM_TIME has come
