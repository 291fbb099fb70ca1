"""An OpenCL driver that ends or hangs the process of the depth stage is named and passed over."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from companion.config import Config
from companion.dense.device_takeover import FAILED_OVER
from companion.geometry.camera import Camera, Distortion
from companion.messages import DepthMap, Warned
from companion.runtime import stage_start
from companion.runtime.parcel import Parcel
from companion.runtime.stage_process import StageProcess
from companion.runtime.stage_protocol import Setup
from companion.runtime.stage_start import start_alone
from companion.runtime.stages import Frames, stage_named
from tests.support.flights.mapped_plane import told
from tests.support.reference.failing_driver import fail, two_devices

CAMERA = Camera(242, 181, 200.0, 199.0, 121.0, 88.0, Distortion.RADTAN, (-0.1, 0.02, 0, 0, 0))
DEPTH = replace(stage_named("depth"), frames=Frames.EVERY)
N, N_BEFORE = 34, 20
LONG_S = 150.0
"""A first kernel may have to be compiled, on a machine that has much else to do."""


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A driver that has made a depth map is waited for eight seconds instead of thirty."""
    monkeypatch.setattr(stage_start, "CHILD", "tests.support.processes.impatient_stage_child")


class Stage:
    """The depth stage's process, with nothing of a daemon around it."""

    def __init__(self, failed: Mapping[str, str]) -> None:
        self._came = threading.Condition()
        self.out: list[Any] = []
        self.why: str | None = None
        self.process = StageProcess(DEPTH, start_alone, self._take, self._ended)
        self.process.begin(Setup(Config(), CAMERA, failed_devices=failed))
        self.until(lambda: self.process.progress is not None or self.why is not None)

    def feed(self, first: int, beyond: int) -> None:
        """Tell it of some of the frames."""
        for k, message in told(CAMERA, beyond):
            if k >= first:
                self.process.offer(Parcel.of(message))

    def of(self, kind: type) -> list[Any]:
        with self._came:
            return [message for message in self.out if isinstance(message, kind)]

    def until(self, such: Callable[[], bool]) -> None:
        """Wait for it; AssertionError where it does not come."""
        until_s = time.monotonic() + LONG_S
        while not such():
            assert time.monotonic() < until_s, f"it gave {self.out}, and ended: {self.why}"
            with self._came:
                self._came.wait(0.1)

    def _take(self, parcel: Parcel) -> None:
        with self._came:
            self.out.append(parcel.open())
            self._came.notify_all()

    def _ended(self, why: str) -> None:
        with self._came:
            self.why = why
            self._came.notify_all()


@pytest.mark.parametrize(
    ("fault", "why"), [("abort", "killed by SIGABRT"), ("hang", "a driver does not come back")]
)
def test_a_driver_that_ends_or_hangs_the_stage_is_named_and_passed_over(
    fault: str, why: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    first, second = two_devices(monkeypatch, tmp_path)
    now = tmp_path / "now"
    fail(monkeypatch, tmp_path, fault, first, when=now)
    stages = [Stage({})]
    try:
        (stage,) = stages
        assert stage.process.progress is not None, stage.why
        assert stage.process.progress.device.startswith(first.named)
        stage.feed(0, N_BEFORE)
        stage.until(lambda: bool(stage.of(DepthMap)))
        now.touch()
        stage.feed(N_BEFORE, N)
        stage.until(lambda: stage.why is not None)
        assert stage.why == why
        driver = stage.process.driver
        assert driver is not None and (driver.identity, driver.named) == (
            first.identity, first.named,
        )  # fmt: skip
        stages.append(Stage({driver.identity: f"{driver.named}: {why}"}))
        stage = stages[-1]
        assert stage.process.progress is not None, stage.why
        assert stage.process.progress.device.startswith(second.named)
        stage.feed(0, N)
        stage.until(lambda: bool(stage.of(DepthMap) and stage.of(Warned)))
        (warned,) = stage.of(Warned)
        assert (warned.what, warned.detail) == (
            FAILED_OVER,
            f"{second.named}; {first.named}: {why}",
        )
    finally:
        for each in stages:
            each.process.kill()


def test_a_stage_that_is_killed_from_outside_blames_no_device(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    first, _ = two_devices(monkeypatch, tmp_path)
    now = tmp_path / "now"
    fail(monkeypatch, tmp_path, "hang", first, when=now)
    stage = Stage({})
    try:
        stage.process._child.kill()  # as the kernel does where memory is short
        stage.until(lambda: stage.why is not None)
        assert (stage.why, stage.process.driver) == ("killed by SIGKILL", None)
    finally:
        stage.process.kill()
