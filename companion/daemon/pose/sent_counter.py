"""Reset counter of the poses sent, tied to the boot of the autopilot and kept on disk."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from companion.daemon.pose.kept_counter import CounterFile, KeptCounter, read_counter
from companion.estimation.gate.pose_gate import PoseGate
from companion.estimation.gate.reset_counter import (
    MAX_BACKWARD_S,
    BootIdentity,
    ResetCounter,
    initial_counter,
    same_boot,
)
from companion.messages import Warned
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_height import AutopilotHeight
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.system.computer_boot import computer_boot

PATIENCE_NS = 1_000_000_000
"""Longest wait of the first pose of a sequence for the disk. Cards in use by a recording take some
tenths of a second; the counter of a reset is written while the pose is proven."""
NO_CLOCK = "no autopilot clock"
WAITING = "disk is slow"
NOT_KEPT = "reset counter is not kept"


class SentCounter:
    """Restores the kept counter, and keeps the one that is sent. To be used in the event loop.

    Where nothing can be kept, poses are sent all the same, with a counter that was probably never
    sent before; a single warning says so.
    """

    def __init__(
        self,
        path: Path,
        counter: ResetCounter,
        height: AutopilotHeight,
        link: AutopilotLink,
        clock: FlightClock,
        warn: Callable[[Warned], None],
    ) -> None:
        self._counter, self._height, self._link, self._clock = counter, height, link, clock
        self._warn, self._computer = warn, computer_boot()
        self._file = CounterFile(path)
        self._kept: KeptCounter | None = None
        self._unreadable = ""
        try:
            self._kept = read_counter(path)
        except (OSError, ValueError) as error:
            self._unreadable = f"{path}: {error}"
        self._boot: BootIdentity | None = None
        self._asked: KeptCounter | None = None
        self._asked_ns = 0
        self._said = False

    def step(self, gate: PoseGate) -> None:
        """Detect another boot of the autopilot, and keep a changed counter; to be called often."""
        before, now = self._boot, self._identity()
        if now is None:
            return
        self._boot = now
        if before is None:
            gate.autopilot_booted(self._kept_for(now))
        elif now.autopilot_s < before.autopilot_s - MAX_BACKWARD_S:
            self._height.forget()
            gate.autopilot_booted(None)
        elif not same_boot(before, now):  # it stood still, or is one that nobody heard begin
            gate.autopilot_booted(self._counter.value if self._counter.sent else None)
        if self._counter.sent:
            self._ask()

    def may_start(self, now_ns: int) -> str:
        """Reason why no first pose of a sequence may be sent now; "" if it may."""
        if self._boot is None:
            return NO_CLOCK
        asked = self._ask()
        trouble = self._file.trouble_with(asked)
        if not trouble and not self._file.has(asked):
            if now_ns - self._asked_ns < PATIENCE_NS:
                return WAITING
            trouble = f"{self._file.path}: the disk does not answer"
        if trouble:
            self._say(trouble)
            if not self._counter.sent:
                self._begin_unlike_any()
        return ""

    def _ask(self) -> KeptCounter:
        """Write the counter as it is now, unless already requested."""
        asked, boot = self._asked, self._boot
        assert boot is not None
        if (
            asked is None or asked.reset_counter != self._counter.value
            or not same_boot(asked.boot, boot)
        ):  # fmt: skip
            asked = KeptCounter(boot, self._counter.value, self._height.home_down_m)
            self._asked, self._asked_ns = asked, self._clock.now_ns()
            self._file.ask(asked)
        return asked

    def _kept_for(self, boot: BootIdentity) -> int | None:
        """Counter last sent to this boot by a process before; None without one."""
        if self._unreadable:
            self._say(self._unreadable)
            return initial_counter(self._clock.now_ns() * 1e-9) - 1
        if self._kept is None or not same_boot(self._kept.boot, boot):
            return None
        self._height.resume(self._kept.home_down_m)
        return self._kept.reset_counter

    def _begin_unlike_any(self) -> None:
        self._counter.booted(initial_counter(self._clock.now_ns() * 1e-9) - 1)

    def _identity(self) -> BootIdentity | None:
        vehicle, report = self._link.vehicle, self._link.clock_filter.report()
        if vehicle is None or report is None:
            return None
        now_s, boot_s = self._clock.now_ns() * 1e-9, report.offset_s
        return BootIdentity(
            vehicle.system_id, now_s - boot_s, boot_s - self._clock.epoch_ns * 1e-9, boot_s,
            self._computer,
        )  # fmt: skip

    def _say(self, why: str) -> None:
        if not self._said:
            self._said = True
            self._warn(Warned(self._clock.now_ns(), NOT_KEPT, why))
