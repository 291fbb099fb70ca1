"""Every selected OpenCL device passes the self-test."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from companion.app.devices_command import devices
from companion.dense.opencl import POCL, PROCESSOR, open_device
from companion.dense.self_test import SIZE, SelfTest, engine_for, reconstruct, scene
from companion.errors import DeviceError
from companion.messages import PixelState
from tests.support.reference import opencl_devices
from tests.support.reference.failing_driver import WrongDevice


@pytest.mark.parametrize("number", opencl_devices.working())
def test_devices_pass(number: str) -> None:
    device = opencl_devices.opened(number)
    SelfTest(device).run()
    it = scene(*SIZE)
    found = reconstruct(engine_for(device, it), it)
    known = found.state == PixelState.CONVERGED.value
    assert known.mean() > 0.8
    error = np.abs(found.depth - it.depth)[known] / it.depth[known]
    assert np.median(error) < 0.01 and (error < 0.03).mean() > 0.95


def test_wrong_results_are_rejected() -> None:
    good = opencl_devices.best()
    with pytest.raises(DeviceError, match=r"self-test failed: only .* are right"):
        SelfTest(WrongDevice(good.device)).run()


def test_pocl_without_linker_is_rejected(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """It would end the process."""
    every = [
        each for each in opencl_devices.known() if each.platform == POCL and each.kind == PROCESSOR
    ]
    monkeypatch.setenv("PATH", str(tmp_path))
    for each in every:
        with pytest.raises(DeviceError, match="apt install gcc libc6-dev"):
            open_device(each)


def test_devices_are_listed_with_their_speed() -> None:
    document = json.loads(devices(as_json=True, verbose=False))
    listed = document["opencl_devices"]
    assert [device["number"] for device in listed] == [
        each.number for each in opencl_devices.known()
    ]
    assert all((device["frames_per_s"] is None) == bool(device["problem"]) for device in listed)
    works = [each["number"] for each in listed if each["frames_per_s"]]
    assert document["opencl_auto"]["number"] in works
