"""Which devices the dense engine may run on, and in which order: the fastest of the right ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import pyopencl as cl

from companion.dense.opencl import ACCELERATOR, GPU, PROCESSOR, ListedDevice, open_device
from companion.dense.self_test import SelfTest, frames_per_s
from companion.errors import DeviceError

Clock = Callable[[], float]
AS_FAST = 1.2
"""Devices whose speeds differ by less count as equally fast: two measurements of the same device
differ by so much where other programs run beside them."""
KINDS = (GPU, ACCELERATOR, PROCESSOR)
"""Of equally fast ones the first: what is left of the processor is the pose's."""


@dataclass(frozen=True, slots=True)
class MeasuredDevice(ListedDevice):
    """A device after its test; `frames_per_s` is None where it failed, and `problem` says how."""

    frames_per_s: float | None = None
    problem: str = ""
    """In words, on one line."""
    detail: str = ""
    """What driver and compiler said."""

    @property
    def listed(self) -> ListedDevice:
        """What is known of it without a test."""
        return ListedDevice(self.number, self.name, self.platform, self.kind, self.driver)


def measured(
    listed: ListedDevice, frames_per_s: float | None, problem: str = "", detail: str = ""
) -> MeasuredDevice:
    """A device with what its test has shown; a problem is one line without a semicolon.

    Semicolons stand between devices, for `companion status` to tell them apart.
    """
    problem = " ".join(problem.split()).replace("; ", ", ")
    return MeasuredDevice(
        **asdict(listed), frames_per_s=frames_per_s, problem=problem, detail=detail
    )


def measured_device(listed: ListedDevice, seconds: Clock) -> MeasuredDevice:
    """Test and measure a device in this process, which its driver may end; `seconds` is a clock."""
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
    """Those that are right, the one to be taken first, then what takes over if that fails.

    The fastest first; between those within `AS_FAST` of it a fixed order decides, so that two
    starts choose alike.
    """
    left = [(each.frames_per_s, each) for each in devices if each.frames_per_s is not None]
    out = []
    while left:
        fastest = max(speed for speed, _ in left)
        alike = [entry for entry in left if entry[0] * AS_FAST >= fastest]
        first = min(alike, key=lambda entry: _fixed_order(entry[1]))
        left.remove(first)
        out.append(first[1])
    return out


def _fixed_order(device: MeasuredDevice) -> tuple[int, str, str, str, str]:
    """Its number comes last: it depends on the order in which a folder lists drivers."""
    kind = KINDS.index(device.kind)
    return kind, device.platform, device.name, device.driver, device.number


def why_taken(taken: ListedDevice, devices: Sequence[MeasuredDevice]) -> str:
    """Why a device comes first, in words."""
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
