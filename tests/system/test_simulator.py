"""ArduCopter's firmware in its simulator, flown by MAVSDK through our link and its router.

    ARDUCOPTER=…/build/sitl/bin/arducopter make system-test

MAVSDK does by its public interface what it is made for: it sets parameters, arms, takes off, lands,
and listens. It holds the wire too where `expert.link.backend` says so. Without firmware skipped;
a minute for each backend.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import mavsdk
import numpy as np
import pytest
from mavsdk.plugins.action import Action, ActionError
from mavsdk.plugins.param import Param
from mavsdk.plugins.telemetry import Telemetry

from companion.config import LinkConfig, RouterConfig
from companion.telemetry import ArmedSample, PositionSample, PositionSource
from companion.telemetry import Telemetry as Sample
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.parameters import Parameters
from drivers.mavlink.wire.link_port import link_port
from tests.support.autopilot.fake_wire import free_port

FIRMWARE = Path(os.environ.get("ARDUCOPTER", ""))
DEFAULTS = "Tools/autotest/default_params/copter.parm"
ALTITUDE_M = 5.0

pytestmark = [
    pytest.mark.skipif(not FIRMWARE.is_file(), reason="needs $ARDUCOPTER, built for its simulator"),
    pytest.mark.timeout(300),
]


@contextlib.contextmanager
def simulator(folder: Path, port: int) -> Iterator[None]:
    """The firmware, over Canberra, which speaks to this port."""
    command = [
        str(FIRMWARE), "--model", "quad", "--home", "-35.363262,149.165237,584,0", "--wipe",
        "--defaults", str(FIRMWARE.parents[3] / DEFAULTS),
        "--serial0", f"udpclient:127.0.0.1:{port}",
    ]  # fmt: skip
    with (folder / "arducopter.out").open("wb") as out:
        process = subprocess.Popen(
            command, cwd=folder, stdin=subprocess.DEVNULL, stdout=out, stderr=subprocess.STDOUT
        )
        try:
            yield
        finally:
            process.kill()
            process.wait()


def until(holds: Callable[[], object], timeout_s: float) -> None:
    end_s = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < end_s, "it did not come about"
        time.sleep(0.5)


def is_done(*actions: Callable[[], object]) -> bool:
    try:
        for action in actions:
            action()
    except ActionError:
        return False
    return True


def fly(url: str) -> float:
    """Up and down again; the height at which it hovered, by MAVSDK."""
    station = mavsdk.Configuration.create_with_component_type(mavsdk.ComponentType.GROUND_STATION)
    with mavsdk.Mavsdk(station) as ground:
        assert ground.add_any_connection(url) == mavsdk.ConnectionResult.SUCCESS
        vehicle = ground.first_autopilot(30)
        assert vehicle is not None
        param, action, telemetry = Param(vehicle), Action(vehicle), Telemetry(vehicle)
        param.set_param_float("PSC_JERK_XY", 4.5)
        assert param.get_param_float("PSC_JERK_XY") == 4.5
        param.set_param_int("DISARM_DELAY", 7)
        action.set_takeoff_altitude(ALTITUDE_M)
        until(lambda: is_done(action.arm, action.takeoff), 90)  # once it knows where it is

        def height_m() -> float:
            return float(telemetry.position().relative_altitude_m)

        until(lambda: abs(height_m() - ALTITUDE_M) < 0.3, 30)
        time.sleep(2)
        hovered_m = height_m()
        action.land()
        until(lambda: not telemetry.armed(), 40)
        return hovered_m


@pytest.mark.parametrize("backend", ["pymavlink", "mavsdk"])
def test_a_flight_through_the_link_and_its_router(
    backend: Literal["pymavlink", "mavsdk"], tmp_path: Path
) -> None:
    autopilot, router = free_port(), free_port()
    config = LinkConfig(url=f"udpin:127.0.0.1:{autopilot}", backend=backend)
    clock = FlightClock()
    port = link_port(config, RouterConfig((f"tcpin:127.0.0.1:{router}",)), clock)
    samples: list[Sample] = []

    async def run() -> float:
        link = AutopilotLink(config, port, clock, samples.append, lambda _: None)
        serving = asyncio.create_task(link.run())
        try:
            hovered_m = await asyncio.to_thread(fly, f"tcpout://127.0.0.1:{router}")
            parameters = Parameters(link)
            read = await parameters.read(["PSC_JERK_XY", "DISARM_DELAY", "NO_SUCH_NAME"])
            assert {name: each.value for name, each in read.items()} == {
                "PSC_JERK_XY": 4.5, "DISARM_DELAY": 7.0,
            }  # fmt: skip
            print(backend, link.clock_filter.report(), link.rates_hz)
            return hovered_m
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)

    with simulator(tmp_path, autopilot):
        hovered_m = asyncio.run(run())
    down = [
        each.position_ned_m[2] for each in samples
        if isinstance(each, PositionSample) and each.source is PositionSource.LOCAL
    ]  # fmt: skip
    assert -np.min(down) == pytest.approx(hovered_m, abs=0.5)
    armed = [each.armed for each in samples if isinstance(each, ArmedSample)]
    assert armed[-2:] == [True, False]
