"""The OpenCL device: chosen, named, its program built once."""

from __future__ import annotations

import os
import shutil
import warnings
from collections import deque
from importlib import resources
from typing import Any

import pyopencl as cl
from numpy.typing import NDArray

from companion.config import OpenclConfig
from companion.errors import DeviceError

WANT = (
    "install PoCL (pip install 'companion[cpu]' on x86-64, apt install pocl-opencl-icd elsewhere),"
    " or set depth.enabled=false"
)
POCL, LINKERS = "Portable Computing Language", ("ld", "ld.lld")
UPLOAD, READ_BACK = "upload", "read-back"
MAX_COPIES = 4096


class ComputeDevice:
    """A device with its context and one in-order queue that measures."""

    def __init__(self, device: cl.Device) -> None:
        self.device = device
        self.why = ""
        """Why it was taken, where it was chosen among others."""
        self.name = f"{device.name.strip()} ({device.platform.name.strip()})"
        self.context = cl.Context([device])
        self.queue = cl.CommandQueue(
            self.context, properties=cl.command_queue_properties.PROFILING_ENABLE
        )
        self.copies: deque[tuple[str, cl.Event]] = deque(maxlen=MAX_COPIES)
        """The last ones, as `UPLOAD` or `READ_BACK`, for who wants to know their times."""

    @property
    def described(self) -> str:
        """Its name, and why it was taken."""
        return f"{self.name}, {self.why}" if self.why else self.name

    def build(self, source_name: str, constants: dict[str, int]) -> cl.Program:
        """Build kernels/`source_name` with -D constants; DeviceError with the compiler's log."""
        source = (resources.files("companion.depth") / "kernels" / source_name).read_text()
        options = [f"-D{name}={value}" for name, value in constants.items()]
        try:
            with warnings.catch_warnings():  # a compiler's remarks on a build that went well
                warnings.simplefilter("ignore", cl.CompilerWarning)
                program: cl.Program = cl.Program(self.context, source).build(options=options)
                return program
        except cl.RuntimeError as error:
            raise DeviceError(f"{self.name}: kernels do not build: {error}") from error

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
    """How long a finished command ran on the device."""
    event.wait()
    return float(event.profile.end - event.profile.start) * 1e-6


def _devices() -> list[tuple[str, cl.Device]]:
    try:
        platforms = cl.get_platforms()
    except cl.LogicError:
        return []
    return [
        (f"{i}:{j}", device)
        for i, platform in enumerate(platforms)
        for j, device in enumerate(platform.get_devices())
    ]


def device_names() -> list[tuple[str, str, str]]:
    """Number, name and platform of every device there is, as `opencl.device` takes them."""
    return [(n, d.name.strip(), d.platform.name.strip()) for n, d in _devices()]


def open_device(config: OpenclConfig) -> ComputeDevice:
    """The device that the configuration names; "auto" prefers a GPU; DeviceError if none."""
    # PoCL: one thread of work per core, and no spinning while waiting
    os.environ.setdefault("POCL_AFFINITY", "0")
    found = _devices()
    if not found:
        raise DeviceError(f"no OpenCL device on this machine: {WANT}")
    if config.device == "auto":
        found.sort(key=lambda d: (not d[1].type & cl.device_type.GPU, d[0]))
        return _usable(found[0][1])
    wanted = config.device.lower()
    for number, device in found:
        if (
            wanted == number
            or wanted in device.name.lower()
            or wanted in device.platform.name.lower()
        ):
            return _usable(device)
    names = "; ".join(f"{n} {d.name.strip()} ({d.platform.name.strip()})" for n, d in found)
    raise DeviceError(f"opencl.device = {config.device!r} is none of: {names}")


def _usable(device: Any) -> ComputeDevice:
    """PoCL ends the whole process where it finds no linker: better to say so before."""
    on_processor = device.type & cl.device_type.CPU
    if POCL in device.platform.name and on_processor and not any(map(shutil.which, LINKERS)):
        raise DeviceError(
            f"{device.name.strip()}: PoCL links kernels with `ld`, which is not installed: "
            "apt install gcc libc6-dev"
        )
    return ComputeDevice(device)
