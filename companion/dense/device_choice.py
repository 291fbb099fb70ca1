"""Selection and order of devices for the dense engine: the fastest correct one first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import pyopencl as cl

from companion.dense.opencl import ACCELERATOR, GPU, PROCESSOR, ListedDevice, open_device
from companion.dense.self_test import SelfTest, frames_per_s
from companion.errors import DeviceError

Clock = Callable[[], float]
SPEED_TOLERANCE = 1.2
"""Devices within this speed ratio count as equally fast: measurements under load vary by as much.
"""
KINDS = (GPU, ACCELERATOR, PROCESSOR)
"""Preference among equally fast ones: the processor is needed for the pose."""


@dataclass(frozen=True, slots=True)
class MeasuredDevice(ListedDevice):
    """A tested device; `frames_per_s` is None where it failed, for the reason `problem`."""

    frames_per_s: float | None = None
    problem: str = ""
    """In words, on one line."""
    detail: str = ""
    """Output of driver and compiler."""

    @property
    def listed(self) -> ListedDevice:
        """The device without test results."""
        return ListedDevice(self.number, self.name, self.platform, self.kind, self.driver)


def measured(
    listed: ListedDevice, frames_per_s: float | None, problem: str = "", detail: str = ""
) -> MeasuredDevice:
    """A device with its test results; a problem is one line without a semicolon.

    Semicolons stand between devices, for `companion status` to tell them apart.
    """
    problem = " ".join(problem.split()).replace("; ", ", ")
    return MeasuredDevice(
        **asdict(listed), frames_per_s=frames_per_s, problem=problem, detail=detail
    )


def measured_device(listed: ListedDevice, seconds: Clock) -> MeasuredDevice:
    """Test and time a device in this process, which its driver may end; `seconds` is a clock."""
    try:
        device = open_device(listed)
        SelfTest(device).run()
        return measured(listed, frames_per_s(device, seconds))
    except DeviceError as error:
        problem = str(error).removeprefix(f"{listed.named}: ")
        return measured(listed, None, problem, error.detail)
    except cl.Error as error:
        return measured(listed, None, "fails while it computes", str(error))


def in_order(devices: Sequence[MeasuredDevice]) -> list[MeasuredDevice]:
    """Working devices, in order of preference.

    Fastest first; within `SPEED_TOLERANCE` of it a fixed order, so that the choice is reproducible.
    """
    left = [(each.frames_per_s, each) for each in devices if each.frames_per_s is not None]
    out = []
    while left:
        fastest = max(speed for speed, _ in left)
        equally_fast = [entry for entry in left if entry[0] * SPEED_TOLERANCE >= fastest]
        first = min(equally_fast, key=lambda entry: _fixed_order(entry[1]))
        left.remove(first)
        out.append(first[1])
    return out


def _fixed_order(device: MeasuredDevice) -> tuple[int, str, str, str, str]:
    """Its number comes last: it depends on the listing order of driver files."""
    kind = KINDS.index(device.kind)
    return kind, device.platform, device.name, device.driver, device.number


def why_taken(taken: ListedDevice, devices: Sequence[MeasuredDevice]) -> str:
    """Reason for the choice of a device, in words."""
    if len(devices) == 1:
        return "the only one"
    speeds = {each.number: each.frames_per_s for each in devices if each.frames_per_s is not None}
    speed, n = speeds.get(taken.number, 0.0), len(devices)
    if len(speeds) == 1:
        how = f"the only one of {n} that works"
    elif speed >= max(speeds.values()):
        how = f"the fastest of {n}"
    else:
        how = f"first in the fixed order of those within 20 % of the fastest of {n}"
    others = "; ".join(
        f"{each.name or each.platform} {each.problem or f'{each.frames_per_s:.0f}'}"
        for each in devices
        if each.number != taken.number
    )
    return f"{how}: {speed:.0f} frames/s; {others}"
