"""Stages of one flight, each in a process of its own, so that none can delay or crash another.

Messages pass through here closed (see `parcel`). A stage that dies takes nothing with it but its
own state: the table says whether it begins again within the flight, or ends it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from companion.runtime.gathered_samples import GatheredSamples, Samples
from companion.runtime.parcel import Parcel, allow_descriptors
from companion.runtime.stage_process import FRAME, StageProcess
from companion.runtime.stage_protocol import Finish, SetLoadLevel, Setup
from companion.runtime.stage_start import Start
from companion.runtime.stages import START_S, Death, Stage
from companion.telemetry import TELEMETRY, Telemetry
from companion.timing.clock import monotonic_s

MAP, READS = "MapUpdate", "LinkReads"
STALLED = "it hung for {:.0f} s and was ended"
NO_PROCESS = "no process could be started for it: {}"
LONGEST_WAIT_S = 30.0
"""Longest pause between two starts of a stage that dies repeatedly."""
TICK_S = 0.02


@dataclass(frozen=True, slots=True)
class Supervisor:
    """Callbacks, called from threads of the stages; they must not block."""

    setup: Callable[[Stage, int, dict[str, str]], Setup]
    """Setup of a stage that has been restarted so often; the OpenCL devices that have failed, by
    identity, and how."""
    heard: Callable[[Parcel], None]
    """A message of a stage, after the other stages have got it."""
    restarted: Callable[[Stage, str], None]
    """A stage has died and is started again: the reason in words."""
    over: Callable[[str], None]
    """A stage has died without which there is no flight."""
    unusable: Callable[[str], None]
    """A stage could never start because of the user's input."""


class InProcesses:
    """Processes of the given stages, from `start` on.

    `publish` may be called from any thread, and never waits. What a stage's own thread changes is
    changed with the lock held: which process a stage has, how often it was started, and whether the
    flight has begun or is over.
    """

    def __init__(self, stages: Iterable[Stage], start: Start, supervisor: Supervisor) -> None:
        allow_descriptors()
        self._start_child, self._supervisor = start, supervisor
        self._rows = {stage.name: stage for stage in stages}
        self._listens = {
            stage.name: {kind.__name__ for kind in stage.listens} for stage in self._rows.values()
        }
        self.muted: set[str] = set()
        """Stages that get no messages,"""
        self.frames_apart_s: Mapping[str, float] = {}
        """and those that get a frame in so many seconds only."""
        self._frame_ns: dict[str, int] = {}
        self.n_restarted = dict.fromkeys(self._rows, 0)
        self._lock = threading.Lock()
        self._map_lock = threading.Lock()
        """Held while a map is passed on: a stage never gets an older one after a newer one."""
        self._samples = GatheredSamples(self._offer_samples)
        self._over = threading.Event()
        self._flies = False
        self._hurry_s: float | None = None
        self._newest_map: Parcel | None = None
        self._load_levels: dict[str, SetLoadLevel] = {}
        """Newest by stage, also of one that is yet to start."""
        self._failed_devices: dict[str, str] = {}
        self._interrupted_at: set[str] = set()
        """Devices that were at work when a stage was ended for not answering."""
        self._added: set[str] = set()
        self.by_name: dict[str, StageProcess] = {}

    def start(self) -> None:
        """Start all processes; callbacks may come before it returns. OSError or RuntimeError."""
        try:
            with self._lock:
                for stage in self._rows.values():
                    self.by_name[stage.name] = self._start(stage)
                for stage in self._rows.values():
                    self._set_up(stage)
        except BaseException:  # no process, thread or descriptor for one: nobody ends the others
            self._over.set()
            for process in self.by_name.values():
                process.kill()
            raise

    @property
    def over(self) -> bool:
        """True once the flight is over, and messages go to its results only."""
        return self._over.is_set()

    @property
    def up(self) -> bool:
        """True if every stage that can run is up, or has failed to start and is retried."""
        return all(
            process.progress is not None or self.n_restarted[name]
            for name, process in list(self.by_name.items())
            if self._flies or not self._rows[name].with_flight
        )

    def fly(self) -> None:
        """Begin the flight: the stages that begin with it get their setup."""
        with self._lock:
            self._flies = True
            for stage in self._rows.values():
                if stage.with_flight:
                    self._set_up(stage)

    def add(self, stage: Stage) -> None:
        """Start a stage during the flight; OSError or RuntimeError where no process can begin."""
        with self._lock:
            if self._over.is_set() or stage.name in self.by_name:
                return
            process = self._start(stage)
            self._added.add(stage.name)
            self._rows[stage.name] = stage
            self._listens[stage.name] = {kind.__name__ for kind in stage.listens}
            self.n_restarted.setdefault(stage.name, 0)
            self.by_name[stage.name] = process
            self._set_up(stage)

    def take(self, message: Any) -> None:
        """Pass a message to all stages that listen to it: a sample soon, with those beside it."""
        if isinstance(message, TELEMETRY):
            self._samples.put(message)
        else:
            self.publish(Parcel.of(message))

    def publish(self, parcel: Parcel) -> None:
        """Pass a closed message to all stages that listen to it."""
        if parcel.kind != READS:  # which have gathered for longer than samples do
            self._samples.let_go()
        if parcel.kind != MAP:
            self._offer(parcel)
            return
        with self._map_lock:
            self._newest_map = parcel
            self._offer(parcel)

    def _offer(self, parcel: Parcel) -> None:
        for name, process in list(self.by_name.items()):
            if parcel.kind not in self._listens[name] or name in self.muted:
                continue
            if parcel.kind != FRAME or self._is_due(name, parcel.t_ns):
                process.offer(parcel)

    def _is_due(self, name: str, t_ns: int) -> bool:
        apart_s = self.frames_apart_s.get(name)
        if apart_s is None:
            return True
        before_ns = self._frame_ns.setdefault(name, t_ns)
        if t_ns - before_ns < apart_s * 1e9:
            return False
        self._frame_ns[name] = t_ns
        return True

    def _offer_samples(self, samples: list[Telemetry]) -> None:
        whole: Parcel | None = None
        for name, process in list(self.by_name.items()):
            listens = self._listens[name]
            heard = [each for each in samples if type(each).__name__ in listens]
            if not heard or name in self.muted:
                continue
            if len(heard) < len(samples):
                process.offer(_together(heard))
                continue
            whole = whole or _together(samples)
            process.offer(whole)

    def order(self, name: str, control: Any) -> None:
        """Send a control message to a stage, if there is one of that name.

        A load level also holds for the process that takes its place.
        """
        self._samples.let_go()
        if isinstance(control, SetLoadLevel):
            self._load_levels[name] = control
        if name in self.by_name:
            self.by_name[name].order(control)

    def bring_up_to_date(self, name: str) -> None:
        """Give a stage that starts in flight the newest map."""
        with self._map_lock:
            if self._newest_map is not None and MAP in self._listens[name]:
                self.by_name[name].offer(self._newest_map)

    def end_stalled(self) -> None:
        """End stages that hang, so that they are restarted."""
        now_s = monotonic_s()
        for name, process in list(self.by_name.items()):
            allowed_s = self._rows[name].answer_s if process.progress is not None else START_S
            stalled_s = process.stalled_s(now_s)
            if stalled_s > allowed_s and not self._over.is_set():
                process.interrupt(STALLED.format(stalled_s))

    def hurry(self) -> None:
        """Have `finish` end within three seconds."""
        self._hurry_s = monotonic_s()

    @property
    def hurried(self) -> bool:
        """True if the end has only a short time."""
        return self._hurry_s is not None

    def finish(self, finish: Callable[[Stage], Finish]) -> dict[str, str]:
        """Have the stages give their last results, those first that others listen to. Blocks.

        Returned are stages that did not in time, and what is known of why.
        """
        self._samples.let_go()
        with self._lock:
            self._over.set()
        late: dict[str, str] = {}
        if self._flies:
            leaves = [stage for stage in self._rows.values() if not stage.is_source]
            for stage in self._rows.values():
                if stage.is_source:
                    self._ask(stage, finish(stage))
                    self._wait(stage, late)
            for stage in leaves:
                self._ask(stage, finish(stage))
            for stage in reversed(leaves):
                self._wait(stage, late)
        for process in self.by_name.values():
            process.kill()
        return late

    def _ask(self, stage: Stage, finish: Finish) -> None:
        process = self.by_name.get(stage.name)
        if process is not None and process.alive:
            process.ask_to_finish(finish)

    def _wait(self, stage: Stage, late: dict[str, str]) -> None:
        """Wait for the last results of a stage that was asked for them."""
        process = self.by_name.get(stage.name)
        if process is None or not process.asked_to_end:
            return
        began_s = monotonic_s()
        while not process.wait(TICK_S):
            now_s, hurry_s = monotonic_s(), self._hurry_s
            if now_s > began_s + stage.finish_s or (
                hurry_s is not None and now_s > max(began_s, hurry_s) + stage.hurried_s
            ):
                break
        if not process.has_finished:
            late[stage.name] = process.failed.why if process.failed is not None else ""

    def _start(self, stage: Stage) -> StageProcess:
        return StageProcess(
            stage, self._start_child, self._supervisor.heard, lambda why: self._ended(stage, why)
        )

    def _set_up(self, stage: Stage) -> None:
        if self._flies or not stage.with_flight:
            n, failed = self.n_restarted[stage.name], dict(self._failed_devices)
            self.by_name[stage.name].begin(self._supervisor.setup(stage, n, failed))

    def _ended(self, stage: Stage, why: str) -> None:
        """Handle the end of a stage's process; called from its own thread."""
        if not why:
            return
        with self._lock:
            if self._over.is_set():
                return
            if stage.death is Death.ENDS_FLIGHT:
                self._over.set()
        name = stage.name
        gone, n_before = self.by_name[name], self.n_restarted[name]
        never_up = not n_before and gone.progress is None and name not in self._added
        is_unusable = gone.failed is not None and gone.failed.by_input and never_up
        if stage.death is Death.ENDS_FLIGHT:
            if is_unusable:  # told first: on the ground no other flight is to begin then
                self._supervisor.unusable(why)
            self._supervisor.over(why)
            return
        self._supervisor.restarted(stage, why)
        self._blame_driver(gone, why)
        if is_unusable:
            self._supervisor.unusable(why)
        while not (n_before and self._over.wait(pause_s(n_before))):
            n_before += 1
            try:
                return self._start_again(stage)
            except (OSError, RuntimeError) as error:
                self._supervisor.restarted(stage, NO_PROCESS.format(in_words(error)))

    def _start_again(self, stage: Stage) -> None:
        with self._lock:
            if self._over.is_set():
                return
            gone = self.by_name[stage.name]
            self.by_name[stage.name] = self._start(stage)
            self.n_restarted[stage.name] += 1
            gone.kill()
            self._set_up(stage)
            if stage.name in self._load_levels:
                self.by_name[stage.name].order(self._load_levels[stage.name])
        self.bring_up_to_date(stage.name)

    def _blame_driver(self, gone: StageProcess, why: str) -> None:
        """Exclude a device whose driver has ended a stage from the rest of the flight.

        A stage may have been too slow to answer for other reasons; that counts the second time.
        """
        driver = gone.driver
        if driver is None:
            return
        if gone.was_interrupted and driver.identity not in self._interrupted_at:
            self._interrupted_at.add(driver.identity)
            return
        self._failed_devices[driver.identity] = f"{driver.named}: {why}"


def _together(samples: list[Telemetry]) -> Parcel:
    return Parcel.of(Samples(samples[0].t_ns, tuple(samples)))


def pause_s(n_before: int) -> float:
    """Pause before a start that so many others came before."""
    return min(2.0 ** min(n_before - 1, 10), LONGEST_WAIT_S)  # a float has no 2.0**1024


def in_words(error: OSError | RuntimeError) -> str:
    """Reason why a process or thread could not be started."""
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
