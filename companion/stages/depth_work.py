"""Stage `depth`: dense depth and cloud."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from companion.compute.compute_devices import choose_devices
from companion.dense.depth_stage import DepthStage
from companion.dense.device_takeover import Devices, unsupervised
from companion.dense.opencl import ListedDevice
from companion.messages import DepthMap, Message
from companion.runtime.stage_protocol import DriverAtWork, Finish, Remark, SetLoadLevel, Setup
from companion.runtime.stage_work import Work
from drivers.system.file_pages import give_back_library_pages
from drivers.system.heap import give_back_heap

FIRST_PATIENCE_S = 120.0
"""Drivers may compile kernels when they first run: on a small processor that takes most of a
minute."""
PATIENCE_S = 30.0
"""A depth map takes 0.1 to 2 s, on an overloaded processor 20 s."""

MAPS_PER_TRIM = 20
"""Depth maps after which the heap is returned again, which takes milliseconds: of what frames and
depth maps free of it, 10 to 20 MB would stay."""


class _Depth(Work):
    def __init__(self, setup: Setup) -> None:
        super().__init__()
        self._setup = setup
        self._tell: Callable[[Any], None] = lambda _: None
        self._used = ""
        """Identity of the device that was last at work."""
        self._proven: set[str] = set()
        """Devices that have made a depth map."""
        self._n_maps = 0
        self._devices: Devices | None = None
        self._stage: DepthStage | None = None

    def begin(self, tell: Callable[[Any], None]) -> None:
        """Choose the device, which may take long."""
        self._tell = tell
        setup = self._setup
        self._devices = choose_devices(
            setup.config.opencl, lambda text: tell(Remark(text)), setup.failed_devices,
            self._watched if setup.is_live else unsupervised,
        )  # fmt: skip
        self._stage = DepthStage(
            setup.config.depth, setup.config.cloud, setup.camera, self._devices, self.times
        )
        self.device = self._devices.described
        self._give_back()

    def details(self) -> Mapping[str, Any]:
        return {"failures": list(self._devices.failures) if self._devices is not None else []}

    def step(self, message: Any) -> Iterable[Message]:
        assert self._stage is not None and self._devices is not None
        if isinstance(message, SetLoadLevel):
            self._stage.set_share(message.level)
            return []
        out = self._stage.step(message)
        if any(isinstance(each, DepthMap) for each in out):
            self._n_maps += 1
            if self._used not in self._proven:
                self._proven.add(self._used)
                self._give_back()  # drivers compile kernels when these first run
            elif self._setup.is_live and self._n_maps % MAPS_PER_TRIM == 0:
                give_back_heap()
        self.device = self._devices.described
        return out

    def finish(self, finish: Finish) -> Iterable[Message]:
        assert self._stage is not None
        return [] if finish.hurry else self._stage.flush()

    def _give_back(self) -> None:
        """Return to the system what compiling kernels has left unused, and the compiler itself."""
        give_back_heap()
        if self._setup.is_live:  # in a process of its own
            give_back_library_pages()

    @contextmanager
    def _watched(self, device: ListedDevice) -> Iterator[None]:
        """Watchdog: SIGALRM ends the process where the driver does not return.

        The kernel sends it, whatever the driver holds.
        """
        self._used = device.identity
        patience_s = PATIENCE_S if self._used in self._proven else FIRST_PATIENCE_S
        self._tell(DriverAtWork(device.identity, device.named))
        signal.setitimer(signal.ITIMER_REAL, patience_s)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            self._tell(DriverAtWork())


work = _Depth
"""The stage for a setup."""
