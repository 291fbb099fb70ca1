"""The flights: one on standby, the current one, and those whose results are being written."""

from __future__ import annotations

import asyncio
import shutil
import threading
from collections.abc import Callable
from pathlib import Path

from companion.config import Config
from companion.daemon.flights.flight_dates import FlightDates
from companion.daemon.flights.kept_map_place import kept_map_path
from companion.daemon.flights.live_flight import Listener, LiveFlight, Taken
from companion.geometry.camera import Camera
from companion.messages import Frame
from companion.messages.run_facts import RunFacts
from companion.products.newest_file import NewestFile
from companion.runtime.stage_protocol import KeepMap
from companion.runtime.stage_start import Start
from companion.telemetry import ArmedSample
from companion.timing.clock import FlightClock
from drivers.recording.flights_folder import COUNTER, UNARMED, flight_name, next_number
from drivers.system.journal import WARNING, Journal

LOOK_S = 0.02
MARKED_S = 1.0
"""Longest wait for the disk to take the mark of a flight."""


class Flights:
    """Begins and ends flights. To be used in the event loop, except `frame`."""

    def __init__(
        self,
        clock: FlightClock,
        journal: Journal,
        listener: Callable[[LiveFlight], Listener],
        facts: Callable[[LiveFlight], RunFacts],
        dates: FlightDates,
        start: Start,
    ) -> None:
        self._dates, self._start = dates, start
        self._counter: NewestFile | None = None
        self._last_number = 0
        self._clock, self._journal, self._listener, self._facts = clock, journal, listener, facts
        self.current: LiveFlight | None = None
        self._mark: NewestFile | None = None
        """Marks the current flight's folder as long as it is not kept."""
        self._standby: LiveFlight | None = None
        self._armed: bool | None = None
        """State of the motors; None as long as the autopilot was not heard."""
        self._ending: dict[LiveFlight, threading.Thread] = {}

    @property
    def stages_up(self) -> bool:
        """True if the current flight, or else the one on standby, can take frames."""
        flight = self.current or self._standby
        return flight is not None and flight.stages_up

    @property
    def standby(self) -> LiveFlight | None:
        """Flight whose processes wait for its beginning; None without one."""
        return self._standby

    def prepare(self, config: Config, camera: Camera) -> None:
        """Start the processes of the next flight."""
        if self._standby is None:
            self._standby = LiveFlight(config, camera, self._clock, self._listener, self._start)

    def begin(
        self, config: Config, camera: Camera, take_up: bool = True, keep: bool = True
    ) -> LiveFlight:
        """Begin a flight; the one before must have been ended.

        With `take_up` it continues the map of a process that died in the air, if there is one and
        it relocalises. Unless `keep`, its folder goes when it ends, if `keep` was not called.
        """
        self.prepare(config, camera)
        folder = self._named(Path(config.daemon.flights))
        flight, self._standby = self._standby, None
        assert flight is not None and self.current is None
        self.current = flight
        try:
            flight.begin(folder, KeepMap(kept_map_path(config.daemon.socket), take_up))
        except BaseException:  # no descriptor or thread for it: its stages are to end
            self.end()
            raise
        if self._armed is not None:  # the autopilot's word is told on change only
            flight.take(ArmedSample(self._clock.now_ns(), self._armed))
        if keep:
            self.keep()
        else:
            self._mark = NewestFile(folder / UNARMED, self._not_marked)
            self._mark.put(b"")
            self._journal.say("localisation begins; the flight is kept once the motors are armed")
        return flight

    def keep(self) -> None:
        """Keep the current flight's folder: the motors are armed."""
        flight = self.current
        if flight is None or flight.kept or flight.folder is None:
            return
        flight.kept = True
        if self._mark is not None:
            self._mark.put(None)
        self._journal.say(f"flight {flight.folder.name} begins; its results go to {flight.folder}")

    def write_results(self) -> None:
        """Write the results of the current flight so far."""
        if self.current is not None:
            self.current.write_results(self._facts(self.current))

    def end(self) -> None:
        """End the current flight; its results are written in the background."""
        flight, self.current = self.current, None
        mark, self._mark = self._mark, None
        if flight is None:
            return
        if not flight.kept:
            flight.hurry()
        thread = threading.Thread(target=self._finish, args=(flight, mark), name="end", daemon=True)
        self._ending[flight] = thread
        thread.start()

    def discard_standby(self) -> None:
        """End the standby flight; the next one is prepared anew."""
        standby, self._standby = self._standby, None
        if standby is not None:
            threading.Thread(target=standby.finish, args=(self._facts,), daemon=True).start()

    def frame(self, frame: Frame) -> None:
        """Take a frame; from the camera's thread."""
        flight = self.current
        if flight is not None:
            flight.frame(frame)

    def take(self, message: Taken) -> None:
        """Take what does not come of the flight's stages, but for frames."""
        if isinstance(message, ArmedSample):
            self._armed = message.armed
        if self.current is not None:
            self.current.take(message)

    async def close(self, patience_s: float, hurried: Callable[[], bool], keep_map: bool) -> None:
        """End all flights, once `hurried` within `patience_s`.

        With `keep_map` the next daemon may continue the map.
        """
        if self.current is not None:
            self.current.keep_map = keep_map
        self.end()
        self.discard_standby()
        if not hurried() and any(flight.kept for flight in self._ending):
            self._journal.say("results are written; Ctrl-C again ends at once")
        while self._is_ending and not hurried():
            await asyncio.sleep(LOOK_S)
        for flight in list(self._ending):
            flight.hurry()
        rounds = round(patience_s / LOOK_S)
        while rounds and self._is_ending:
            await asyncio.sleep(LOOK_S)
            rounds -= 1

    @property
    def _is_ending(self) -> bool:
        return any(thread.is_alive() for thread in list(self._ending.values()))

    def _finish(self, flight: LiveFlight, mark: NewestFile | None) -> None:
        flight.finish(self._facts)
        if mark is not None:
            mark.close(MARKED_S)
        if flight.kept and flight.folder is not None:
            folder = self._dates.ended(flight.folder)
            self._journal.say(f"flight over: {folder} ({flight.n_frames} frames)")
        elif flight.folder is not None:
            shutil.rmtree(flight.folder, ignore_errors=True)  # what is left stays marked
            self._dates.deleted(flight.folder)
        self._ending.pop(flight, None)

    def _named(self, parent: Path) -> Path:
        """Folder of the next flight: a number never used before, and the time, UTC."""
        if self._counter is None or self._counter.path.parent != parent:
            if self._counter is not None:
                self._counter.close()
            self._counter, self._last_number = NewestFile(parent / COUNTER, self._not_counted), 0
        self._last_number = max(next_number(parent), self._last_number + 1)
        self._counter.put(b"%d\n" % self._last_number)
        t_ns = self._clock.now_ns()
        folder = parent / flight_name(self._last_number, self._dates.unix_s(t_ns))
        self._dates.begun(folder, t_ns)
        return folder

    def _not_marked(self, why: str) -> None:
        self._journal.say(f"warning: a flight is not marked as not armed: {why}", WARNING)

    def _not_counted(self, why: str) -> None:
        self._journal.say(f"warning: the number of the flight is not kept: {why}", WARNING)
