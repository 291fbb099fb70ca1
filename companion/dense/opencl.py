"""OpenCL devices: listing, opening, building programs."""

from __future__ import annotations

import os
import shutil
import warnings
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import pyopencl as cl
from numpy.typing import NDArray

from companion.errors import DeviceError

# Both are read by libraries when they are first called.
# PoCL: one thread of work per core, and no spinning while waiting.
os.environ.setdefault("POCL_AFFINITY", "0")
# ocl-icd would initialise every driver to sort platforms, and one of them may abort.
os.environ.setdefault("OCL_ICD_PLATFORM_SORT", "none")

WANT = (
    "sudo apt install pocl-opencl-icd (without root, on x86-64: make opencl), "
    "or the driver of your GPU; or set depth.enabled=false"
)
POCL, LINKERS = "Portable Computing Language", ("ld", "ld.lld")
GPU, ACCELERATOR, PROCESSOR = "GPU", "accelerator", "processor"
UPLOAD, READ_BACK = "upload", "read-back"
MAX_COPIES = 4096


@dataclass(frozen=True, slots=True)
class ListedDevice:
    """A device as its driver names it; `number` is PLATFORM:DEVICE."""

    number: str
    name: str
    platform: str
    kind: str = PROCESSOR
    """GPU, ACCELERATOR or PROCESSOR."""
    driver: str = ""
    """Versions of platform and driver."""

    @property
    def named(self) -> str:
        """Name and platform."""
        return f"{self.name} ({self.platform})" if self.name else self.platform

    @property
    def identity(self) -> str:
        """Distinguishes devices, and driver versions of the same device."""
        return f"{self.number} {self.kind} {self.named} {self.driver}"


class ComputeDevice:
    """A device with its context and one in-order profiling queue."""

    def __init__(self, device: cl.Device) -> None:
        self.device = device
        self.why = ""
        """Reason why it was chosen among several devices; "" where it is the only one."""
        self.name = f"{device.name.strip()} ({device.platform.name.strip()})"
        self.context = cl.Context([device])
        self.queue = cl.CommandQueue(
            self.context, properties=cl.command_queue_properties.PROFILING_ENABLE
        )
        self.copies: deque[tuple[str, cl.Event]] = deque(maxlen=MAX_COPIES)
        """The latest copies, as `UPLOAD` or `READ_BACK`, for timing."""

    @property
    def described(self) -> str:
        """Its name, and why it was chosen."""
        return f"{self.name}, {self.why}" if self.why else self.name

    def build(self, source_name: str, constants: dict[str, int]) -> cl.Program:
        """Build kernels/`source_name` with -D constants; DeviceError with the compiler's log."""
        source = (resources.files("companion.dense") / "kernels" / source_name).read_text()
        options = [f"-D{name}={value}" for name, value in constants.items()]
        try:
            with warnings.catch_warnings():  # compiler remarks on a successful build
                warnings.simplefilter("ignore", cl.CompilerWarning)
                program: cl.Program = cl.Program(self.context, source).build(options=options)
                return program
        except cl.RuntimeError as error:
            kind = _kind(self.device)
            what = f"this {kind}" if kind == PROCESSOR else "it"
            raise DeviceError(
                f"{self.name}: kernels do not build for {what}", str(error)
            ) from error

    def buffer(self, n_bytes: int) -> cl.Buffer:
        """A read-write buffer."""
        return cl.Buffer(self.context, cl.mem_flags.READ_WRITE, n_bytes)

    def write(self, buffer: cl.Buffer, array: NDArray[Any]) -> cl.Event:
        """Copy a contiguous array to a buffer and wait."""
        event = cl.enqueue_copy(self.queue, buffer, array, is_blocking=True)
        self.copies.append((UPLOAD, event))
        return event

    def read(self, array: NDArray[Any], buffer: cl.Buffer) -> None:
        """Copy a buffer to a contiguous array and wait."""
        self.copies.append(
            (READ_BACK, cl.enqueue_copy(self.queue, array, buffer, is_blocking=True))
        )


def event_ms(event: cl.Event) -> float:
    """Device time of a finished command."""
    event.wait()
    return float(event.profile.end - event.profile.start) * 1e-6


def platform_names() -> list[str]:
    """All platforms, without opening their devices."""
    try:
        return [platform.name.strip() for platform in cl.get_platforms()]
    except cl.Error:
        return []  # the answer of a loader without drivers


def devices_of(platform: int) -> list[ListedDevice]:
    """Devices of a platform by its number, without initialising other drivers."""
    try:
        return [
            _listed(f"{platform}:{i}", device)
            for i, device in enumerate(cl.get_platforms()[platform].get_devices())
        ]
    except cl.Error:
        return []


def _listed(number: str, device: cl.Device) -> ListedDevice:
    driver = f"{device.platform.version.strip()}, {device.driver_version.strip()}"
    return ListedDevice(
        number, device.name.strip(), device.platform.name.strip(), _kind(device), driver
    )


def _kind(device: cl.Device) -> str:
    if device.type & cl.device_type.GPU:
        return GPU
    return ACCELERATOR if device.type & cl.device_type.ACCELERATOR else PROCESSOR


def device_asked_for(asked: str, listed: Sequence[ListedDevice]) -> ListedDevice:
    """The device that `opencl.device` names; DeviceError if none."""
    wanted = asked.lower()
    for each in listed:
        if wanted == each.number or wanted in each.name.lower() or wanted in each.platform.lower():
            return each
    names = "; ".join(f"{each.number} {each.named}" for each in listed)
    raise DeviceError(f"opencl.device = {asked!r} is none of: {names}")


def open_device(listed: ListedDevice) -> ComputeDevice:
    """Open a device in this process; DeviceError where it is missing, changed or unusable."""
    try:
        platform, device = (int(part) for part in listed.number.split(":"))
        found = cl.get_platforms()[platform].get_devices()[device]
        if _listed(listed.number, found).identity != listed.identity:
            raise DeviceError(f"{listed.named}: is not there any more")
        return _usable(found)
    except (cl.Error, IndexError) as error:
        raise DeviceError(f"{listed.named}: cannot be opened", str(error)) from error


def linkers() -> list[str]:
    """Paths of installed linkers that PoCL can use."""
    return [path for path in map(shutil.which, LINKERS) if path is not None]


def _usable(device: cl.Device) -> ComputeDevice:
    """Check for a linker: PoCL ends the process without one."""
    if POCL in device.platform.name and _kind(device) == PROCESSOR and not linkers():
        raise DeviceError(
            f"{device.name.strip()} ({device.platform.name.strip()}): PoCL links kernels with "
            "`ld`, which is not installed: apt install gcc libc6-dev"
        )
    return ComputeDevice(device)
