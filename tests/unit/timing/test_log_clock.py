from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.geometry.transforms import Array
from companion.timing.log_clock import BootSegments, clock_from_utc, estimate_clock

Times = NDArray[np.int64]
S = 10**9
HOST_NS = 1_762_000_000 * S
OFFSET_NS = HOST_NS - 83 * S


def host_of(remote_ns: Times, ppm: float = 14.0) -> Times:
    """Truth: the autopilot's clock runs fast by `ppm`."""
    gained: Times = np.rint(remote_ns * (ppm * 1e-6)).astype(np.int64)
    host: Times = OFFSET_NS + remote_ns - gained
    return host


def stamps(seconds: float, rate_hz: float = 50.0) -> Times:
    return np.array(83 * S + np.arange(0, seconds, 1 / rate_hz) * S, np.int64)


def one_way(remote: Times, delay_s: Array, ppm: float = 14.0) -> Times:
    receive = host_of(remote, ppm) + (delay_s * S).astype(np.int64)
    return np.stack([remote, receive, np.zeros_like(remote)], 1)


def exchanges(remote: Times, up_s: Array, down_s: Array) -> Times:
    host = host_of(remote)
    send, receive = host - (up_s * S).astype(np.int64), host + (down_s * S).astype(np.int64)
    return np.stack([send, remote, receive, np.zeros_like(remote)], 1)


def test_exchanges_give_offset_and_drift(rng: np.random.Generator) -> None:
    remote = stamps(60, 10)
    up, down = rng.exponential(0.004, (2, len(remote))) + 0.001
    clock = estimate_clock(exchanges(remote, up, down), [])
    assert clock is not None
    error_ms = (clock.host_ns(remote, 0) - host_of(remote)) * 1e-6
    assert np.abs(error_ms).max() < 1.0
    assert clock.report.method == "TIMESYNC"
    assert clock.report.drift_ppm == pytest.approx(14, abs=10)
    assert clock.report.offset_s == pytest.approx((host_of(remote)[0] - remote[0]) / S, abs=1e-3)
    assert np.abs(error_ms).mean() < 3 * clock.report.sigma_ms


def test_loaded_link(rng: np.random.Generator) -> None:
    """Stamps late by up to 80 ms: the least delays tell."""
    remote = stamps(60)
    delay = 0.002 + 0.08 * rng.random(len(remote)) ** 3
    clock = estimate_clock([], one_way(remote, delay))
    assert clock is not None
    error_ms = (clock.host_ns(remote, 0) - host_of(remote)) * 1e-6
    assert (error_ms > 0).mean() > 0.99  # the least delay itself cannot be seen
    assert np.abs(error_ms - 2).max() < 1.5
    assert clock.report.method == "least delay"
    assert clock.report.sigma_ms > 2.0  # and is admitted


def test_slow_simulator_clock(rng: np.random.Generator) -> None:
    remote = stamps(80)
    delay = rng.exponential(0.01, len(remote))
    clock = estimate_clock([], one_way(remote, delay, ppm=-12_000))
    assert clock is not None
    error_ms = (clock.host_ns(remote, 0) - host_of(remote, -12_000)) * 1e-6
    assert np.abs(error_ms).max() < 3
    assert clock.report.drift_ppm == pytest.approx(-12_000, rel=0.02)


def test_clock_with_varying_rate(rng: np.random.Generator) -> None:
    """A simulator on a loaded machine: no line fits, the curve does."""
    remote = stamps(100)
    bend_ns = (0.05 * S * np.sin((remote - remote[0]) / (20 * S))).astype(np.int64)
    rows = one_way(remote, rng.exponential(0.005, len(remote)))
    rows[:, 1] += bend_ns
    clock = estimate_clock([], rows)
    assert clock is not None
    error_ms = (clock.host_ns(remote, 0) - host_of(remote) - bend_ns) * 1e-6
    assert np.abs(error_ms).max() < 6


def test_messages_bound_the_offset_of_slow_answers(rng: np.random.Generator) -> None:
    """The autopilot answers late after taking its stamp; nothing arrives before it is sent."""
    remote = stamps(30, 10)
    small = np.full(len(remote), 1e-4)
    stale = exchanges(remote, small, small)
    stale[:, [0, 2]] += S // 100  # as if all were 10 ms later
    clock = estimate_clock(stale, one_way(stamps(30), rng.exponential(0.002, 1500)))
    assert clock is not None
    assert np.abs(clock.host_ns(remote, 0) - host_of(remote)).max() < 2e6
    assert clock.report.sigma_ms > 5


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_few_samples(n: int) -> None:
    remote = stamps(n * 5, 0.2)
    clock = estimate_clock([], one_way(remote, np.full(n, 0.003)))
    assert clock is not None
    error_ms = (clock.host_ns(remote, 0) - host_of(remote)) * 1e-6
    assert np.abs(error_ms - 3).max() < 1.0


def test_no_samples() -> None:
    assert estimate_clock([], []) is None
    assert clock_from_utc([]) is None


def test_reboot_starts_a_segment(rng: np.random.Generator) -> None:
    before, after = stamps(40), stamps(20) - 82 * S
    segments = BootSegments()
    first = one_way(before, rng.exponential(0.003, len(before)))
    second = one_way(after, rng.exponential(0.003, len(after)))
    second[:, 1] += 130 * S
    rows = np.concatenate([first, second])
    rows[:, 2] = [segments.segment_of(int(remote)) for remote in rows[:, 0]]
    assert set(rows[:, 2]) == {0, 1}
    clock = estimate_clock([], rows)
    assert clock is not None
    assert clock.report.n_reboots == 1
    truth = np.concatenate([host_of(before), host_of(after) + 130 * S])
    assert np.abs(clock.host_ns(rows[:, 0], rows[:, 2]) - truth).max() < 3e6


def test_reordered_messages_are_no_reboot() -> None:
    segments = BootSegments()
    assert [segments.segment_of(t * S // 10) for t in (50, 51, 48, 52)] == [0, 0, 0, 0]


def test_utc_of_a_log(rng: np.random.Generator) -> None:
    remote = stamps(60, 5)
    utc = host_of(remote, 20) - (rng.exponential(0.02, len(remote)) * S).astype(np.int64)
    clock = clock_from_utc(np.c_[remote, utc])
    assert clock is not None
    error_ms = (clock.host_ns(remote, 0) - host_of(remote, 20)) * 1e-6
    assert np.abs(error_ms).max() < 6
    assert clock.report.sigma_ms >= 100
    assert clock.report.offset_s == pytest.approx(OFFSET_NS / S, abs=0.01)


def test_extrapolation_is_linear() -> None:
    remote = stamps(60)
    clock = estimate_clock([], one_way(remote, np.zeros(len(remote)), ppm=500))
    assert clock is not None
    later = remote[-1:] + 30 * S
    assert abs(int((clock.host_ns(later, 0) - host_of(later, 500))[0])) < 1e6
