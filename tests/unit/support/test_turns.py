"""A flight that wants all cores is alone in the air; others fly beside each other."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.processes.turns import ALL_CORES

CONFTEST = f"""
from pathlib import Path
from tests.support.processes import turns

def pytest_configure(config):
    for marker in "real_time", "{ALL_CORES}":
        config.addinivalue_line("markers", marker)
    turns.FOLDER = Path(__file__).parent / "turns"
    config.pluginmanager.register(turns.Turns())
"""
FLIGHT = """
import time
from pathlib import Path
import pytest

@pytest.mark.real_time
{marks}
def test_flight():
    own = Path(__file__).with_suffix(".flying")
    own.touch()
    until_s = time.monotonic() + {seconds}
    alone = True
    while time.monotonic() < until_s and alone:
        alone = len(list(own.parent.glob("*.flying"))) == 1
        time.sleep(0.01)
    if alone:
        own.unlink()  # else it stays, for the other to see
    assert alone
"""


@pytest.mark.parametrize(
    ("marks", "seconds", "verdict"),
    [(f"@pytest.mark.{ALL_CORES}", 1, "2 passed"), ("", 30, "2 failed")],
)
def test_who_flies_beside_whom(tmp_path: Path, marks: str, seconds: int, verdict: str) -> None:
    (tmp_path / "conftest.py").write_text(CONFTEST)
    for name, own in (("a", marks), ("b", "")):
        text = FLIGHT.format(marks=own, seconds=seconds)
        (tmp_path / f"test_{name}.py").write_text(text)
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-n2",
        "--dist",
        "loadfile",
        "-p",
        "no:cacheprovider",
    ]
    done = subprocess.run([*command, str(tmp_path)], capture_output=True, text=True, timeout=120)
    assert verdict in done.stdout, done.stdout
