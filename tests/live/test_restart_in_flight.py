"""Restart of daemon or localisation in the air: the map is resumed.

The vehicle circles until its pose is sent, and hovers from then on: nothing would ever tell a new
map its scale. What the killed one kept is taken up.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator

import pytest

from tests.support.autopilot.received_poses import Poses
from tests.support.flights.halting import Halting
from tests.support.processes.flying import MOST_AWAY_M, MOST_TURNED_DEG, PROOF_S, Flying

pytestmark = pytest.mark.continues

STARTED_S = 15.0
"""A daemon comes up, its camera and its link are open, and its stages have begun, in this time;"""
STAGE_S = 8.0
"""a flight's stages alone in this."""
RECOGNISED_S = 2.0
KEPT_S = 2.5
"""So long after the last pose was told everything there is to know is kept."""


@pytest.fixture(scope="module")
def flying(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Flying]:
    path = Halting()
    with Flying(tmp_path_factory.mktemp("restart"), path=path) as begun:
        begun.until_source("camera", "running")
        begun.until_source("autopilot", "running")
        begun.take_off()
        time.sleep(KEPT_S)
        path.hover()
        time.sleep(KEPT_S)
        yield begun


def since(flying: Flying, from_ns: int) -> Poses:
    """The poses that came after a time."""
    poses = flying.poses
    return poses.after(from_ns * 1e-9)


def assert_taken_up(flying: Flying, lost_ns: int, started_s: float) -> None:
    """Poses come again, after proof, where the vehicle is."""
    flying.until_sending()
    line = flying.daemon.line("map resumed after restart", after_ns=lost_ns)
    flying.until_told("Companion: map resumed after restart", lost_ns)
    poses = since(flying, lost_ns + round(0.5e9))
    away_m, turned_deg = flying.errors(poses)
    took_s = float(poses.came_s[0]) - lost_ns * 1e-9
    recognised_s = (line.monotonic_ns - lost_ns) * 1e-9
    print(
        f"{took_s:.1f} s without a pose, recognised after {recognised_s:.1f} s;"
        f" wrong by {away_m.max():.2f} m and {turned_deg.max():.1f} deg at most"
    )
    assert away_m.max() < MOST_AWAY_M
    assert turned_deg.max() < MOST_TURNED_DEG
    first_ns = round(float(poses.came_s[0]) * 1e9)
    flying.assert_soon(lost_ns, first_ns, started_s + RECOGNISED_S + PROOF_S)


def test_a_daemon_that_is_killed(flying: Flying) -> None:
    resets = flying.poses.resets[-1]
    killed_ns = flying.start_again(signal.SIGKILL)
    assert_taken_up(flying, killed_ns, STARTED_S)
    (told,) = set(since(flying, killed_ns + round(0.5e9)).resets.tolist())
    assert told > resets, "the autopilot is told once, by a counter that it was not sent before"


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["dies", "hangs"])
def test_a_localisation_that(flying: Flying, number: signal.Signals) -> None:
    flying.until_sending()
    time.sleep(KEPT_S)
    resets = flying.poses.resets[-1]
    lost_ns = flying.daemon.signal_stage("localisation", number)
    named_ns = flying.daemon.line("localisation has died", after_ns=lost_ns).monotonic_ns
    assert_taken_up(flying, named_ns, STAGE_S)
    assert flying.poses.resets[-1] > resets


def test_a_daemon_that_is_told_to_end_in_the_air(flying: Flying) -> None:
    told_ns = flying.start_again()
    assert_taken_up(flying, told_ns, STARTED_S)


def test_nothing_is_kept_once_the_flight_is_over(flying: Flying) -> None:
    kept = flying.daemon.socket.with_name("map.checkpoint")
    flying.daemon.until(
        lambda _: kept.exists() and 10_000 < kept.stat().st_size < 5_000_000, "the map is kept"
    )
    disarmed_ns = time.monotonic_ns()
    flying.autopilot.disarm()
    flying.daemon.line("disarmed", after_ns=disarmed_ns)
    flying.assert_stops()
    assert not kept.exists()
    assert not flying.daemon.said("Traceback")
