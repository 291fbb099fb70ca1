"""Devices whose driver fails: real ones, spoilt by failing_driver.c in processes that load it.

pair = two_devices(monkeypatch, tmp_path)
fail(monkeypatch, tmp_path, "abort", pair[0])
"""

from __future__ import annotations

import subprocess
from pathlib import Path

import pyopencl as cl
import pytest

from companion.compute.device_probe import listed_devices
from companion.compute.device_verdict import circumstances, keep_verdict, verdict_path
from companion.dense.device_choice import MeasuredDevice, measured
from companion.dense.opencl import POCL, ComputeDevice
from tests.support.reference import opencl_devices

SOURCE = Path(__file__).with_suffix(".c")
SPEEDS = (100.0, 50.0)
NOT_HERE = "not wanted in this test"


class WrongDevice(ComputeDevice):
    """Counts bits as a broken compiler might."""

    def build(self, source_name: str, constants: dict[str, int]) -> cl.Program:
        if source_name != "sweep.cl":
            return super().build(source_name, constants)
        return super().build(source_name, {**constants, "UNRELATED": 2})


def two_devices(
    monkeypatch: pytest.MonkeyPatch, folder: Path, known: tuple[bool, bool] = (True, True)
) -> list[MeasuredDevice]:
    """Two that work, for processes begun from now on, in the order in which "auto" takes them.

    They are of one PoCL, which has a device with threads and one without. Where `known`, the
    verdict on them is kept in the folder; all other devices are refused.
    """
    good = next(
        (each for each in opencl_devices.known() if each.number == opencl_devices.working()[0]),
        None,
    )
    assert good is not None, "no OpenCL device works"
    if good.platform != POCL:
        pytest.skip("another OpenCL than PoCL has one device only here")
    monkeypatch.setenv("POCL_DEVICES", "pthread basic")
    monkeypatch.setenv("CACHE_DIRECTORY", str(folder / "cache"))  # PoCL's kernels stay elsewhere
    listed, _ = listed_devices()
    pair = [each for each in listed if each.driver == good.driver]
    assert len(pair) == 2
    pair.sort(key=lambda each: each.name != good.name)
    found = [measured(each, speed) for each, speed in zip(pair, SPEEDS, strict=True)]
    kept = [each for each, is_known in zip(found, known, strict=True) if is_known]
    kept += [measured(each, None, NOT_HERE) for each in listed if each not in pair]
    path = verdict_path()
    assert path is not None
    keep_verdict(path, circumstances(listed), kept)
    return found


def fail(
    monkeypatch: pytest.MonkeyPatch, folder: Path, fault: str, device: MeasuredDevice, *,
    after: int = 0, when: Path | None = None,
) -> None:  # fmt: skip
    """Have a device fail in processes begun from now on: build, wrong, abort, hang or lost.

    After so many kernels in a process, or as soon as a file is there.
    """
    library = folder / "failing_driver.so"
    if not library.exists():
        subprocess.run(
            ["gcc", "-shared", "-fPIC", "-O1", "-o", library, SOURCE, "-ldl"], check=True
        )
    values = {
        "LD_PRELOAD": str(library), "FAULT": fault, "FAULT_DEVICE": device.name,
        "FAULT_AFTER": str(after), "FAULT_WHEN": "" if when is None else str(when),
    }  # fmt: skip
    for name, value in values.items():
        monkeypatch.setenv(name, value)
