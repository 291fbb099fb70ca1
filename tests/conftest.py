"""Common setup of all tests: fixed seeds, and no network beyond this machine."""

from __future__ import annotations

import asyncio
import inspect
import ipaddress
import os
import random
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import companion.__main__  # noqa: F401 - limits numeric libraries to one thread, before they load

import numpy as np  # isort: skip
import pytest

from tests.support.left_behind import left_since, running, watch_tasks
from tests.support.processes.steal import FlownAgain

LONGEST = (
    "test_two_nodes", "test_flown_by_vision", "test_as_flown", "test_stage_faults",
    "test_page_in_browser", "test_whole_flight", "test_recording", "test_service",
    "test_dead_reckoning", "test_autopilot_faults", "test_daemon_limits", "test_ground_control",
    "test_armed_settings", "test_restart_in_flight", "test_device_faults", "test_power_on",
)  # fmt: skip
"""Files in real time that take two minutes to half of one. They begin first, in this order, for
workers of pytest-xdist to end together; of what only computes the whole replays begin first."""
MARKS = {"live": ("real_time",), "system": ("real_time", "alone")}
"""Of the tests in these folders."""


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(FlownAgain())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    places = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(places)))
    for item in items:
        kind = item.path.relative_to(Path(__file__).parent).parts[0]
        for mark in MARKS.get(kind, ()):
            item.add_marker(mark)
        if kind == "unit" and item.get_closest_marker("real_time") is not None:
            item.add_marker("light")


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """A test that is a coroutine runs in an event loop of its own."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    given = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}
    asyncio.run(pyfuncitem.obj(**given))
    return True


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20260101)


def goes_on(node: pytest.Item | pytest.Collector) -> bool:
    """Whether what a test begins is ended by its module."""
    return node.get_closest_marker("continues") is not None


@pytest.fixture(autouse=True, scope="module")
def nothing_is_left_behind_by_a_module(request: pytest.FixtureRequest) -> Iterator[None]:
    before = running()
    yield
    left = left_since(before) if goes_on(request.node) else []
    assert not left, f"left behind: {left}"


@pytest.fixture(autouse=True)
def nothing_is_left_behind(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[None]:
    """A test ends what it began: later ones are slower, or fail, by what is left."""
    before = running()
    tasks = watch_tasks(monkeypatch)
    yield
    left = tasks + ([] if goes_on(request.node) else left_since(before))
    assert not left, f"left behind: {left}"


@pytest.fixture(autouse=True)
def fixed_seeds() -> None:
    random.seed(1)
    np.random.seed(1)  # noqa: NPY002 - for code under test that would wrongly use the global state


@pytest.fixture(autouse=True)
def loopback_only(monkeypatch: pytest.MonkeyPatch) -> None:
    connect = socket.socket.connect

    def guarded(self: socket.socket, address: Any) -> None:
        if self.family in (socket.AF_INET, socket.AF_INET6):
            host = address[0]
            if host != "localhost" and not ipaddress.ip_address(host).is_loopback:
                raise AssertionError(f"a test reached for the network: {address}")
        connect(self, address)

    monkeypatch.setattr(socket.socket, "connect", guarded)


os.environ.setdefault("MPLBACKEND", "agg")
# with it each process that a test begins compiles the whole program anew: seconds each
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
