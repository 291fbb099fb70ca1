"""Ground commands and parameters: what is allowed, and when; users' guide in docs/control.md.

Everything here runs in the event loop. The MAVLink protocol is in the drivers.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from companion.config import Config
from companion.config.setting_keys import value_of_key
from companion.daemon.control import kept_settings
from companion.daemon.control.armed_settings import NOT_KEPT
from companion.daemon.control.flight_parameters import (
    PARAMETERS,
    FlightParameter,
    number_of,
    value_of,
)
from companion.daemon.control.tightening import may_change
from companion.daemon.control.way_back import WayBack
from companion.daemon.flights.flights import Flights
from companion.daemon.flights.flown_stages import depth_elsewhere
from companion.daemon.flights.new_map import NewMap
from companion.daemon.flights.snapshots import Snapshots
from companion.errors import ConfigError
from companion.messages import Warned
from companion.pilot_messages import (
    CLOUD_NO_MAP,
    NEW_MAP_ARMED,
    NEW_MAP_NO_MAP,
    PARAMETER_NEXT_MAP,
    PARAMETER_SET,
    REFUSED_ARMED,
    REFUSED_ELSEWHERE,
    REFUSED_OFTEN,
    REFUSED_VALUE,
    PilotMessage,
    PilotText,
)
from companion.pilot_messages import NEW_MAP as NEW_MAP_TEXT
from companion.products.newest_file import NewestFile
from companion.runtime.stage_protocol import Snapshot
from companion.timing.clock import FlightClock
from companion.timing.rate_limit import RateLimit
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.ground.command_server import (
    ACCEPTED,
    BUSY,
    DENIED,
    Command,
    CommandServer,
    Done,
    Job,
)
from drivers.mavlink.ground.ground_requests import GroundRequests
from drivers.mavlink.ground.mission_server import MissionServer
from drivers.mavlink.ground.parameter_server import NOT_NOW, OUT_OF_RANGE, SET, ParameterServer
from drivers.system.journal import INFO, WARNING, Journal
from drivers.system.ticks import tick

MAPPING, NEW_MAP, SNAPSHOT, BUDGET = 31010, 31011, 31012, 31013
"""MAV_CMD_USER_1 to MAV_CMD_USER_4."""
STEP_S = 0.05
TEXTS_HZ, TEXTS_AT_ONCE = 0.3, 5.0
"""Rate limit of answers to requests, so that they cannot suppress important texts."""
CHANGES_HZ, CHANGES_AT_ONCE = 2.0, 40.0
"""Rate limit of parameter changes: a burst of as many as there are parameters, then this rate."""
NO_FLIGHT = "there is no flight"
POSES_SENT = "the autopilot may fly on these poses; param1 = 1 does it all the same"
NOT_ARMED = "while armed it can be switched off only", REFUSED_ARMED
ELSEWHERE = "another machine makes the dense map", REFUSED_ELSEWHERE
TOO_OFTEN = "it is set too often", REFUSED_OFTEN
NOT_LOOSER = "while armed it can be made stricter only", REFUSED_ARMED
"""Reason of a refusal: for the journal, and for the pilot."""


class Controlled(Protocol):
    """The daemon, as the ground controls it."""

    @property
    def config(self) -> Config:
        """Configuration in force."""

    @property
    def armed(self) -> bool:
        """True while the motors are armed; the last known state while the autopilot is silent."""

    def take_over(self, config: Config) -> None:
        """Continue with another configuration."""

    def prepare(self) -> None:
        """Start the processes of a standby flight."""

    def begin_flight(self) -> None:
        """Begin a flight, where one is due."""


class GroundControl:
    """Commands and parameters of our component; `changed` are values set by the ground, by key."""

    def __init__(
        self,
        daemon: Controlled,
        link: AutopilotLink,
        clock: FlightClock,
        journal: Journal,
        flights: Flights,
        questions: Mapping[int, Command],
        changed: dict[str, Any],
        warn: Callable[[Warned], None],
    ) -> None:
        self._daemon, self._link, self._journal = daemon, link, journal
        self._clock, self._changes = clock, RateLimit(CHANGES_HZ, CHANGES_AT_ONCE)
        self._texts = RateLimit(TEXTS_HZ, TEXTS_AT_ONCE)
        self._flights, self.changed, self._warn = flights, changed, warn
        self._kept: NewestFile | None = None
        self._new_map = NewMap(flights, daemon.prepare, daemon.begin_flight)
        self._snapshots = Snapshots(flights, self._tell)
        self.way_back = WayBack(
            link, clock, lambda: daemon.armed, lambda: daemon.config.feedback.min_quality,
            self._tell,
        )  # fmt: skip
        commands = {
            MAPPING: Command(self._switch_mapping),
            NEW_MAP: Command(self._begin_new_map),
            SNAPSHOT: Command(self._take_snapshot),
            BUDGET: Command(self._set_budget),
            **questions,
        }
        self._requests = GroundRequests(
            link.port,
            clock,
            CommandServer(commands),
            ParameterServer(self),
            MissionServer(self.way_back.waypoints),
            warn,
        )
        link.on_request = self._requests.take

    async def run(self) -> None:
        """Answer requests and execute long commands, until cancelled."""
        answering = asyncio.ensure_future(self._requests.run())
        try:
            while not answering.done():
                await tick(STEP_S)
                self._new_map.step()
                self._snapshots.step()
            answering.result()
        finally:
            answering.cancel()

    def snapshot_told(self, snapshot: Snapshot) -> None:
        """Take the progress of a snapshot from the results stage."""
        self._snapshots.take(snapshot)

    # -- parameters, as drivers.mavlink.ground.parameter_server wants them ------

    @property
    def names(self) -> Sequence[str]:
        """Names of all parameters, by index."""
        return tuple(PARAMETERS)

    def value(self, name: str) -> float:
        """Value in force."""
        return number_of(self._daemon.config, PARAMETERS[name])

    def set(self, name: str, value: float) -> int:
        """Set one, if allowed now; SET or a MAV_PARAM_ERROR."""
        parameter, config = PARAMETERS[name], self._daemon.config
        try:
            wanted = value_of(config, parameter, value)
            changed = kept_settings.checked(config, parameter, wanted)
        except ConfigError as error:
            self._tell(REFUSED_VALUE(name=name), f"not set: {error}", False)
            return OUT_OF_RANGE
        if changed == config:
            return SET
        why_not = self._forbidden(parameter, wanted)
        if why_not:
            self._tell(why_not[1](name=name), f"not set: {name}: {why_not[0]}", False)
            return NOT_NOW
        when = "" if parameter.at_once else ", from the next map on"
        pilot_text = PARAMETER_SET if parameter.at_once else PARAMETER_NEXT_MAP
        self._tell(
            pilot_text(name=name, value=_shown(wanted, brief=True)),
            f"{parameter.full_key} = {_shown(wanted)}{when}", True,
        )  # fmt: skip
        self._take_over(parameter, wanted, changed)
        return SET

    def _forbidden(
        self, parameter: FlightParameter, wanted: Any
    ) -> tuple[str, PilotMessage] | None:
        """Reason why it is refused now; None if allowed."""
        self._changes.refill(self._clock.now_ns())
        if self._changes.left < 1.0:
            return TOO_OFTEN
        if parameter.full_key == "depth.enabled" and depth_elsewhere(self._daemon.config):
            return ELSEWHERE
        now = value_of_key(self._daemon.config, parameter.full_key)
        if not self._daemon.armed or may_change(parameter.full_key, now, wanted):
            return None
        return NOT_ARMED if parameter.full_key == "feedback.mode" else NOT_LOOSER

    def _take_over(self, parameter: FlightParameter, value: Any, config: Config) -> None:
        self._changes.take(1.0)
        self.changed[parameter.full_key] = value
        self._daemon.take_over(config)
        if config.control.keep:
            self._kept_in(Path(config.control.keep)).put(kept_settings.encoded(self.changed))

    def _kept_in(self, path: Path) -> NewestFile:
        if self._kept is None or self._kept.path != path:
            self.close()
            self._kept = NewestFile(
                path, lambda why: self._warn(Warned(self._clock.now_ns(), NOT_KEPT, why))
            )
        return self._kept

    def close(self, seconds: float = 0.0) -> None:
        """Write settings still to be kept; waits for the disk at most this long."""
        if self._kept is not None:
            self._kept.close(seconds)

    # -- commands --------------------------------------------------------------------------------

    def _switch_mapping(self, parameters: Sequence[float]) -> Done:
        return self._by_parameter("MAP_DENSE", parameters[0])

    def _set_budget(self, parameters: Sequence[float]) -> Done:
        return self._by_parameter("STR_KBIT_S", parameters[0])

    def _by_parameter(self, name: str, value: float) -> Done:
        return Done(ACCEPTED if self.set(name, value) == SET else DENIED)

    def _begin_new_map(self, parameters: Sequence[float]) -> Done | Job:
        all_the_same = parameters[0]
        if all_the_same not in (0.0, 1.0) and not math.isnan(all_the_same):
            return Done(DENIED)
        if self._flights.current is None:
            return self._refused(NEW_MAP_NO_MAP(), f"no new map: {NO_FLIGHT}", BUSY)
        is_fed = self._daemon.config.feedback.mode != "off"
        if self._daemon.armed and is_fed and all_the_same != 1.0:
            return self._refused(NEW_MAP_ARMED(), f"no new map: {POSES_SENT}", DENIED)
        self._tell(NEW_MAP_TEXT(), "a new map begins", True)
        job = Job()
        self._new_map.start(job)
        return job

    def _take_snapshot(self, _parameters: Sequence[float]) -> Done | Job:
        flight = self._flights.current
        if flight is None:
            return self._refused(CLOUD_NO_MAP(), f"no cloud was written: {NO_FLIGHT}", BUSY)
        job = Job()
        self._snapshots.start(flight, self._link.origin, job)
        return job

    def _refused(self, pilot_text: PilotText, what: str, result: int) -> Done:
        self._tell(pilot_text, what, False)
        return Done(result)

    def _tell(self, pilot_text: PilotText, text: str, good: bool) -> None:
        """Answer the pilot, rate-limited, and write the details to the journal."""
        self._texts.refill(self._clock.now_ns())
        in_time = self._texts.left >= 1.0
        if in_time:
            self._texts.take(1.0)
            self._link.say(pilot_text)
        if in_time or good:
            self._journal.say(f"ground: {text}", INFO if good else WARNING)


def _shown(value: Any, brief: bool = False) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:.4g}" if brief else f"{value:g}"
    return str(value)
