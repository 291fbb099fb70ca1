"""Device failover: the device in use is tested periodically, and replaced on failure."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext

import pyopencl as cl

from companion.dense.engine import DepthEngine
from companion.dense.opencl import ComputeDevice, ListedDevice, open_device
from companion.dense.self_test import SelfTest
from companion.errors import DeviceError
from companion.messages import DepthMap, Warned

TEST_PERIOD_NS = 10_000_000_000
"""Depth since the last test may be wrong when a test fails. A test takes a fifth of the time of a
depth map of 640 x 480 (37 and 185 ms of PoCL on a Cascade Lake), of which there are some ten per
period: 2 % of the work."""
FAILED_OVER = "dense map on another OpenCL device"
NO_DEVICE_LEFT = "dense map off: no OpenCL device"
"""Short: autopilot messages have 50 characters."""
FAULTS = (DeviceError, cl.Error)

Watch = Callable[[ListedDevice], AbstractContextManager[None]]
"""Context for work of the driver of a device, for supervision."""


def unsupervised(device: ListedDevice) -> AbstractContextManager[None]:
    """Context without supervision."""
    return nullcontext()


class Devices:
    """Devices in order of preference; `current` is the first that passes its test, or None.

    `failed` are failures earlier in this flight; without any, DeviceError is raised where no device
    works.
    """

    def __init__(
        self,
        order: Sequence[ListedDevice],
        why_taken: Callable[[ListedDevice], str],
        failed: Sequence[str] = (),
        watch: Watch = unsupervised,
    ) -> None:
        self._left = deque(order)
        self._why_taken = why_taken
        self._watch = watch
        self._taken: tuple[ListedDevice, SelfTest] | None = None
        self.current: ComputeDevice | None = None
        self.failures = list(failed)
        """Failed devices, with reasons."""
        self._take_next()
        if self.current is None and not failed:
            raise DeviceError("; ".join(self.failures))

    @property
    def described(self) -> str:
        """The current device, why it was chosen, and earlier failures."""
        parts = [self.current.described if self.current is not None else "none is left"]
        return "; failed: ".join([*parts, *self.failures])

    def at_work(self) -> AbstractContextManager[None]:
        """Supervision context for work of the current device."""
        return self._watch(self._taken[0]) if self._taken is not None else nullcontext()

    def test(self) -> None:
        """Test the current device again; raises one of FAULTS."""
        if self._taken is not None:
            with self.at_work():
                self._taken[1].run()

    def fail(self, error: Exception) -> None:
        """Replace the current device after a failure, if another works."""
        if self.current is not None:
            self.failures.append(in_words(error, self.current.name))
        self._take_next()

    def _take_next(self) -> None:
        self.current, self._taken = None, None
        while self._left and self.current is None:
            listed = self._left.popleft()
            try:
                with self._watch(listed):
                    device = open_device(listed)
                    test = SelfTest(device)
                    test.run()
            except FAULTS as error:
                self.failures.append(in_words(error, listed.named))
                continue
            device.why = self._why_taken(listed)
            self.current, self._taken = device, (listed, test)


def in_words(error: Exception, named: str) -> str:
    """A fault on one line, starting with the device name."""
    text = str(error) if isinstance(error, DeviceError) else f"fails while it computes: {error}"
    first = next(iter(text.splitlines()), "")
    return first if first.startswith(named) else f"{named}: {first}"


class TestedEngine:
    """An engine on the current device, with failover; eventually off."""

    def __init__(self, devices: Devices, make: Callable[[ComputeDevice], DepthEngine]) -> None:
        self._devices, self._make = devices, make
        self._tested_ns: int | None = None
        self._engine: DepthEngine | None = None
        self._n_announced = 0
        no_failures = not devices.failures
        self._start()
        if self.off and no_failures:
            raise DeviceError("; ".join(devices.failures))

    @property
    def off(self) -> bool:
        """True once no device is left."""
        return self._engine is None

    def run(self, t_ns: int, job: Callable[[DepthEngine], DepthMap]) -> DepthMap | None:
        """Run `job` with the engine, restarted on each failover.

        None where no device is left. `t_ns` is flight time, by which tests are scheduled.
        """
        if self._tested_ns is None:
            self._tested_ns = t_ns
        while self._engine is not None:
            try:
                if t_ns - self._tested_ns >= TEST_PERIOD_NS:
                    self._test(t_ns - self._tested_ns)
                    self._tested_ns = t_ns
                with self._devices.at_work():
                    return job(self._engine)
            except FAULTS as error:
                self._devices.fail(error)
                self._engine, self._tested_ns = None, t_ns
                self._start()
        return None

    def announced(self, t_ns: int) -> list[Warned]:
        """Warnings about failures since the last call."""
        failures, current = self._devices.failures, self._devices.current
        if len(failures) == self._n_announced:
            return []
        new, self._n_announced = failures[self._n_announced :], len(failures)
        if current is None:
            return [Warned(t_ns, NO_DEVICE_LEFT, "; ".join(new))]
        return [Warned(t_ns, FAILED_OVER, "; ".join([current.name, *new]))]

    def _test(self, since_ns: int) -> None:
        try:
            self._devices.test()
        except DeviceError as error:
            consequence = f"depth of the {since_ns * 1e-9:.0f} s before may be wrong"
            raise DeviceError(f"{error}; {consequence}") from error

    def _start(self) -> None:
        while self._engine is None and self._devices.current is not None:
            try:
                with self._devices.at_work():
                    self._engine = self._make(self._devices.current)
            except FAULTS as error:
                self._devices.fail(error)
