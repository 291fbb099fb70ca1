from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from companion.config import LinkConfig
from companion.errors import SourceError
from drivers.mavlink.asking_link import asking_link
from drivers.mavlink.parameters import Parameters
from tests.support.autopilot.fake_autopilot import FakeAutopilot


def asking(autopilot: FakeAutopilot, ask: Callable[[Parameters], Awaitable[None]]) -> None:
    autopilot.rates_hz["HEARTBEAT"] = 20.0

    async def run() -> None:
        async with asking_link(LinkConfig(url=autopilot.url), 3.0) as (link, _, _):
            parameters = Parameters(link)
            await ask(parameters)

    with autopilot:
        asyncio.run(run())


def test_integers_of_px4() -> None:
    autopilot = FakeAutopilot("px4", "udpin:127.0.0.1:0")
    numbers = [-1, -(2**31), 2**31 - 1, 1310988, 256, 0]

    async def ask(parameters: Parameters) -> None:
        for number in numbers:
            autopilot.parameters["SYS_AUTOSTART"] = number
            assert (await parameters.read(["SYS_AUTOSTART"]))["SYS_AUTOSTART"].value == number
        await parameters.write("SYS_AUTOSTART", -7)
        assert autopilot.parameters["SYS_AUTOSTART"] == -7

    asking(autopilot, ask)


def test_what_is_not_there_is_left_out() -> None:
    async def ask(parameters: Parameters) -> None:
        read = await parameters.read(["VISO_TYPE", "NO_SUCH_THING", "VISO_SCALE"])
        assert list(read) == ["VISO_TYPE", "VISO_SCALE"]
        with pytest.raises(SourceError, match="does not answer for its parameters"):
            await parameters.read(["NO_SUCH_THING"])

    asking(FakeAutopilot("ardupilot", "udpin:127.0.0.1:0"), ask)


def test_silent_autopilot() -> None:
    autopilot = FakeAutopilot("ardupilot", "udpin:127.0.0.1:0")

    async def ask(parameters: Parameters) -> None:
        autopilot.silent = True
        with pytest.raises(SourceError, match="does not answer for its parameters"):
            await parameters.read(["VISO_TYPE"])

    asking(autopilot, ask)


def test_other_vehicle_is_not_believed() -> None:
    autopilot = FakeAutopilot("ardupilot", "udpin:127.0.0.1:0")

    async def ask(parameters: Parameters) -> None:
        message = autopilot.parameters.value_message("VISO_TYPE")
        message.param_value = 9.0  # type: ignore[attr-defined]
        for _ in range(5):
            autopilot.send(message, system=7)
            autopilot.send(message, component=25)
        assert (await parameters.read(["VISO_TYPE"]))["VISO_TYPE"].value == 0

    asking(autopilot, ask)
