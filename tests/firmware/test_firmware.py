"""The real firmwares on our pose, without GPS from power-on: take-off, hold, one fault, landing.

    ARDUCOPTER=…/arducopter PX4=…/px4 make system-test

Skipped without a firmware built for its simulator. The whole table: `python -m tests.firmware`.
"""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import pytest

from tests.firmware.__main__ import FIRMWARES, fly
from tests.firmware.experiments import EXPERIMENTS

pytestmark = [pytest.mark.real_time, pytest.mark.alone, pytest.mark.timeout(400)]


@pytest.fixture(params=list(FIRMWARES))
def firmware(request: pytest.FixtureRequest) -> str:
    variable = FIRMWARES[request.param]
    if not Path(os.environ.get(variable, "")).is_file():
        pytest.skip(f"needs ${variable}, built for its simulator")
    return str(request.param)


@pytest.mark.parametrize("experiment", ["take_off", "faults"])
def test_flies_on_our_pose(experiment: str, firmware: str, tmp_path: Path) -> None:
    conditions = dataclasses.replace(EXPERIMENTS[experiment][1])
    figures = fly(experiment, firmware, tmp_path, conditions, ["fault=camera gone 2 s"])
    assert figures.rows
    assert figures.hold, "\n".join(str(each) for each in figures.rows if each.holds is False)
