"""OpenCL devices for tests: those that device selection accepts. Without any a test fails."""

from __future__ import annotations

from functools import cache

from companion.compute.compute_devices import _known, _measured, choose_devices, say_on_stderr
from companion.compute.device_probe import listed_devices
from companion.config import OpenclConfig
from companion.dense.device_choice import MeasuredDevice, in_order
from companion.dense.device_takeover import Devices
from companion.dense.opencl import ComputeDevice, open_device


@cache
def known() -> list[MeasuredDevice]:
    """All devices there are, each with its verdict."""
    listed, failed = listed_devices()
    return [*_measured(listed, _known(listed, listed), listed, say_on_stderr), *failed]


def working() -> list[str]:
    """Numbers of the devices that work, to parametrise tests by; never empty."""
    return [each.number for each in in_order(known())] or ["none works"]


def opened(number: str) -> ComputeDevice:
    """One of them; AssertionError where it is missing."""
    found = [each for each in known() if each.number == number]
    assert found, f"no OpenCL device works: {[(each.named, each.problem) for each in known()]}"
    return open_device(found[0])


def best() -> ComputeDevice:
    """The one that "auto" selects."""
    return opened(working()[0])


def devices() -> Devices:
    """As passed to stages."""
    return choose_devices(OpenclConfig())
