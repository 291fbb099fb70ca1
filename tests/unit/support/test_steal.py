"""What fails while the host takes the processors is flown again, and only then."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.processes.steal import worst_share

CONFTEST = """
from tests.support.processes.steal import FlownAgain

class Told:
    shares = [{shares}]
    def worst(self, from_s):
        return self.shares.pop(0)
    def close(self):
        pass

def pytest_configure(config):
    config.addinivalue_line("markers", "real_time: flies")
    config.pluginmanager.register(FlownAgain(Told()))
"""
FLIGHTS = """
import pytest
flights, done = [], []

@pytest.fixture(scope="module")
def flown():
    flights.append(1)
    done.clear()
    return len(flights)

@pytest.mark.real_time
def test_take_off(flown):
    done.append("take off")

@pytest.mark.real_time
def test_cruise(flown):
    assert done == ["take off"]
    assert flown >= {needed}

@pytest.mark.real_time
def test_land(flown):
    assert flown == len(flights)
"""


def fly(folder: Path, needed: int, *shares: float) -> str:
    """What pytest says of a flight that is good from its `needed`th time on."""
    (folder / "conftest.py").write_text(CONFTEST.format(shares=", ".join(map(str, shares))))
    (folder / "test_flight.py").write_text(FLIGHTS.format(needed=needed))
    command = [sys.executable, "-m", "pytest", "-rs", "-p", "no:cacheprovider", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    return done.stdout


@pytest.mark.parametrize(
    ("needed", "shares", "verdict"),
    [
        (1, (), "3 passed"),
        (2, (0.1,), "1 failed, 2 passed"),
        (2, (0.5,), "3 passed"),
        (3, (0.5, 0.3), "3 passed"),
        (3, (0.5, 0.1), "1 failed, 2 passed"),
        (9, (0.5, 0.4, 0.3), "2 passed, 1 skipped"),
    ],
)
def test_it_is_flown_again(
    tmp_path: Path, needed: int, shares: tuple[float, ...], verdict: str
) -> None:
    said = fly(tmp_path, needed, *shares)
    assert verdict in said.splitlines()[-1], said
    assert said.count("FLOWN AGAIN") == min(sum(share >= 0.2 for share in shares), 2)
    if "skipped" in verdict:
        assert "no verdict: the host took 50 %, 40 %, 30 % of the processors" in said


def test_worst_share_of_two_seconds() -> None:
    even = [(0.5 * at, 10.0 * at, 100.0 * at) for at in range(9)]
    assert worst_share(even) == pytest.approx(0.1)
    burst = [*even, (4.5, 150.0, 900.0), (5.0, 160.0, 1000.0)]
    assert worst_share(burst) == pytest.approx((160 - 60) / 400)
    away = [*even, (9.0, 480.0, 1800.0)]
    assert worst_share(away) == pytest.approx((480 - 80) / 1000)
    assert worst_share(even[:3]) == 0.0
    assert worst_share([]) == 0.0
