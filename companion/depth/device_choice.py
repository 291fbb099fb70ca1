"""Which device the dense engine runs on: one that computes right, and of these the fastest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from companion.config import OpenclConfig
from companion.depth.opencl import ComputeDevice, device_names, open_device
from companion.depth.self_test import check, frames_per_s
from companion.errors import DeviceError

Clock = Callable[[], float]


@dataclass(frozen=True, slots=True)
class MeasuredDevice:
    """A device as `opencl.device` can name it; `frames_per_s` is None where it failed."""

    number: str
    name: str
    platform: str
    frames_per_s: float | None
    problem: str = ""


def measured_devices(seconds: Clock) -> list[MeasuredDevice]:
    """All devices there are, each tested and measured for two seconds; `seconds` is a clock."""
    return [measured_device(*each, seconds) for each in device_names()]


def measured_device(number: str, name: str, platform: str, seconds: Clock) -> MeasuredDevice:
    """One of them, by its number."""
    try:
        device = open_device(OpenclConfig(device=number))
        check(device)
        return MeasuredDevice(number, name, platform, frames_per_s(device, seconds))
    except DeviceError as error:
        return MeasuredDevice(number, name, platform, None, str(error))


def choose_device(config: OpenclConfig, seconds: Clock) -> ComputeDevice:
    """The device that the configuration names, if it computes right; DeviceError where it does not.

    "auto" takes the fastest of those that do. `why` of the result says why it was taken.
    """
    names = device_names()
    if config.device != "auto" or len(names) < 2:
        device = open_device(config)
        check(device)
        device.why = "asked for" if config.device != "auto" else "the only one"
        return device
    measured = measured_devices(seconds)
    good = [(m.frames_per_s, m.number) for m in measured if m.frames_per_s is not None]
    if not good:
        raise DeviceError("; ".join(m.problem for m in measured))
    fastest, number = max(good)
    device = open_device(OpenclConfig(device=number))
    device.why = f"the fastest of {len(names)}: {fastest:.0f} frames/s; " + "; ".join(
        f"{m.name} {m.problem or f'{m.frames_per_s:.0f}'}" for m in measured if m.number != number
    )
    return device
