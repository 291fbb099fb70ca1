"""Every OpenCL device there is computes what the program was shipped with; a wrong one is found."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest

from companion.clock import monotonic_s
from companion.config import OpenclConfig
from companion.depth.device_choice import choose_device
from companion.depth.opencl import POCL, ComputeDevice, device_names, open_device
from companion.depth.self_test import SIZE, check, reconstruct, scene
from companion.device_probe import probed
from companion.devices import devices
from companion.errors import DeviceError
from companion.messages import PixelState

EVERY = [number for number, _, _ in device_names()]


class WrongDevice(ComputeDevice):
    """Counts bits as a broken compiler might."""

    def build(self, source_name: str, constants: dict[str, int]) -> cl.Program:
        if source_name != "sweep.cl":
            return super().build(source_name, constants)
        return super().build(source_name, {**constants, "UNRELATED": 2})


@pytest.mark.parametrize("number", EVERY)
def test_devices_pass(number: str) -> None:
    device = open_device(OpenclConfig(device=number))
    check(device)
    it = scene(*SIZE)
    found = reconstruct(device, it)
    known = found.state == PixelState.CONVERGED.value
    assert known.mean() > 0.8
    error = np.abs(found.depth - it.depth)[known] / it.depth[known]
    assert np.median(error) < 0.01 and (error < 0.03).mean() > 0.95


def test_a_device_that_computes_wrongly_is_refused() -> None:
    good = open_device(OpenclConfig())
    with pytest.raises(DeviceError, match=r"self-test failed: only .* are right"):
        check(WrongDevice(good.device))


def test_without_a_linker_pocl_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """It would end the process."""
    monkeypatch.setenv("PATH", str(tmp_path))
    for number, _, platform in device_names():
        if platform == POCL:
            with pytest.raises(DeviceError, match="apt install gcc libc6-dev"):
                open_device(OpenclConfig(device=number))


def test_the_choice_says_why() -> None:
    chosen = choose_device(OpenclConfig(), monotonic_s)
    assert chosen.why.startswith("the only one" if len(EVERY) == 1 else "the fastest of")
    asked = choose_device(OpenclConfig(device=EVERY[0]), monotonic_s)
    assert asked.described.endswith(", asked for")


def test_devices_are_listed_with_their_speed() -> None:
    listed = json.loads(devices(as_json=True))["opencl_devices"]
    assert [device["number"] for device in listed] == EVERY
    assert all(device["frames_per_s"] > 0 and not device["problem"] for device in listed)


@pytest.mark.parametrize(
    ("program", "problem", "patience_s"),
    [
        ("import os; os.abort()", "its driver ends the program (SIGABRT)", 60.0),
        ("import sys; sys.exit('why')", "its driver ends the program (status 1): why", 60.0),
        ("import time; time.sleep(60)", "hangs for 1 s", 1.0),
    ],
)
def test_a_driver_that_ends_its_process_is_named(
    program: str, problem: str, patience_s: float
) -> None:
    found = probed("0:0", "a device", "a platform", (sys.executable, "-c", program), patience_s)
    assert (found.name, found.frames_per_s, found.problem) == ("a device", None, problem)
