"""Switches the sources of ArduPilot's EKF while satellites are doubted, where that is allowed.

Which set is asked for is decided by `companion.estimation.satellites.source_choice`. Runs in the
event loop.
"""

from __future__ import annotations

from collections.abc import Callable, Collection

from companion.config import GpsConfig, Measurement
from companion.daemon.pose.sender import Sender
from companion.estimation.gate.gate_journal import SOURCES, GateJournal
from companion.estimation.gate.gates_again import ANSWERED, ASKED, BOOTED, DOUBT
from companion.estimation.satellites.source_choice import SourceChoice
from companion.flight_notes import GateStep
from companion.messages import Warned
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.system.ticks import tick

TICK_S = 0.1
"""Interval of looks."""
TO_VISION = "the EKF's sources are switched to vision"
TO_SATELLITES = "the EKF's sources are switched to satellites"
ACCEPTED = 0
"""MAV_RESULT."""
NOT_SWITCHED = "the EKF's sources could not be switched"


class SourceSwitch(Sender):
    """Changes the EKF source set by the verdict on satellites.

    `sending` is True with poses; `journal` takes what the choice was made of.
    """

    def __init__(
        self,
        config: GpsConfig,
        link: AutopilotLink,
        clock: FlightClock,
        sending: Callable[[], bool],
        warn: Callable[[Warned], None],
        journal: Callable[[GateStep], None],
    ) -> None:
        self._link, self._clock = link, clock
        self._sending, self._warn = sending, warn
        self._choice = SourceChoice(config)
        self._n_reboots = link.clock_filter.n_reboots
        self._journal = GateJournal(SOURCES, journal)
        self.takes = {Warned: self.take_warning}

    def begin_flight(self, use: Collection[Measurement]) -> None:
        """Begin anew with another flight, of whose telemetry is believed what is in `use`."""
        choice = self._choice
        choice.begin_flight()
        known = {
            "doubted": choice.doubted, "on_vision": choice.on_vision,
            "not_before_ns": choice.not_before_ns,
        }  # fmt: skip
        self._journal.begin(self._clock.now_ns(), known)

    def doubt_satellites(self, doubted: bool) -> None:
        """Doubt satellites, or doubt them no more."""
        self._choice.doubt_satellites(doubted)
        self._journal.step(DOUBT, self._clock.now_ns(), {"doubted": doubted})

    async def run(self) -> None:
        """Switch when due; until cancelled."""
        while True:
            await tick(TICK_S)
            await self.step()

    async def step(self) -> None:
        """Switch if due."""
        now_ns, vehicle = self._clock.now_ns(), self._link.vehicle
        if self._n_reboots != self._link.clock_filter.n_reboots:
            self._n_reboots = self._link.clock_filter.n_reboots
            self._choice.autopilot_booted()
            self._journal.step(BOOTED, now_ns, {})
        if vehicle is None or vehicle.firmware != "ardupilot" or not self._link.alive:
            return
        before, sending = self._choice.doubted, self._sending()
        number = self._choice.due(now_ns, vehicle.armed, sending)
        to_vision = self._choice.doubted
        if number is not None or to_vision != before:
            asked = {
                "armed": vehicle.armed, "sends_poses": sending, "system": vehicle.system_id
            }  # fmt: skip
            self._journal.step(ASKED, now_ns, asked, sent=number is not None)
        if number is None:
            return
        result = await self._link.commands.set_source_set(number)
        now_ns = self._clock.now_ns()
        accepted = None if result < 0 else result == ACCEPTED
        self._choice.answered(to_vision, accepted, now_ns)
        self._journal.step(ANSWERED, now_ns, {"to_vision": to_vision, "accepted": accepted})
        if accepted:
            what = TO_VISION if to_vision else TO_SATELLITES
            self._warn(Warned(now_ns, what, f"set {number}", good=not to_vision))
            return
        detail = f"set {number}: MAV_RESULT {result}" if result >= 0 else f"set {number}: no answer"
        self._warn(Warned(now_ns, NOT_SWITCHED, detail))
