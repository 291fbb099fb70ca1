"""Stages of one flight in one process: each message goes through all of them before the next.

Nothing is lost, and results do not depend on anybody's speed. Localisation works in the caller's
thread; where frames to come are known (`looked_ahead`), their features are extracted beside. Depth,
to which no stage above it listens, has a thread of its own, fed in order through a bounded queue
that makes the caller wait; or a process, as others that give nothing. A depth stage that fails is
left out from there on: trajectory, map and the cloud so far stay.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any

from companion.errors import CompanionError
from companion.messages import Frame, Message, Warned
from companion.runtime.lossless_process import LosslessProcess
from companion.runtime.parcel import Parcel, allow_descriptors
from companion.runtime.peak_memory import peak_memory_mb
from companion.runtime.stage_protocol import Finish, Progress, Remark, Setup
from companion.runtime.stage_start import Start
from companion.runtime.stage_thread import StageThread
from companion.runtime.stage_work import Work, module_of
from companion.runtime.stages import Stage

DEPTH_FAILED = "the dense map ends here: the depth stage has failed"
DEPTH = "depth"
FRAMES_AHEAD = 4
"""A keyframe takes as long as the features of some frames."""


class InOrder:
    """The given stages; feed it messages in order of time.

    `watch` sees every message; one for which it gives False goes no further. `say` takes remarks of
    the stages. With `start` depth and whatever is no source get processes. CompanionError where a
    stage cannot begin.
    """

    def __init__(
        self, stages: Iterable[Stage], setup: Setup, watch: Callable[[Message], object],
        say: Callable[[str], None], start: Start | None = None,
    ) -> None:  # fmt: skip
        self._watch = watch
        self._stages = list(stages)
        self.works: dict[str, Work] = {}
        """Stages of this process."""
        self._thread: StageThread | None = None
        """Thread of depth, if it has no process."""
        self._processes: dict[str, LosslessProcess] = {}
        self._closer = ThreadPoolExecutor(1, "parcels")
        self._closed: dict[int, Future[Parcel]] = {}
        """Frames to come, closed for the processes, by their number."""

        def tell(told: Any) -> None:
            if isinstance(told, Remark):
                say(told.text)

        if start is not None:
            allow_descriptors()
            for stage in self._stages:
                if stage.name == DEPTH or not stage.is_source:
                    self._processes[stage.name] = LosslessProcess(stage, start, say)
        try:
            for process in self._processes.values():
                process.begin(setup)
            for stage in self._stages:
                if stage.name in self._processes:
                    continue
                work = self.works[stage.name] = module_of(stage.name).work(setup)
                if stage.name == DEPTH:
                    self._thread = StageThread(stage.name, work, tell)
                else:
                    work.begin(tell)
            for process in self._processes.values():
                process.wait_until_up()
        except BaseException:
            self._end_processes()
            raise
        self._depth = self._processes.get(DEPTH) or self._thread
        self._fault_reported = False
        self._t_ns = 0

    @property
    def depth_fault(self) -> BaseException | None:
        """Exception of the depth stage; None without one."""
        return self._depth.fault if self._depth is not None else None

    @property
    def times(self) -> dict[str, Mapping[str, float]]:
        """Times of all stages, by name of the work."""
        times = {k: v for each in self._stages for k, v in self.progress(each.name).times.items()}
        return dict(sorted(times.items()))

    @property
    def peak_memory_mb(self) -> float:
        """Peak memory of this process, and of those of stages as they have last told it."""
        apart = sum(each.progress.peak_memory_mb for each in self._processes.values())
        return peak_memory_mb() + apart

    def progress(self, name: str) -> Progress:
        """Progress of a stage, as far as it is known."""
        if name in self._processes:
            return self._processes[name].progress
        return self.works[name].progress

    def looked_ahead(self, messages: Iterable[Message]) -> Iterator[Message]:
        """The same messages; stages see each frame when it is `FRAMES_AHEAD` frames ahead."""
        waiting: deque[Message] = deque()
        n_frames = 0
        try:
            for message in messages:
                waiting.append(message)
                if not isinstance(message, Frame):
                    continue
                n_frames += 1
                if self._processes:
                    self._closed[message.seq] = self._closer.submit(Parcel.of, message)
                for stage in self._stages:
                    if isinstance(message, stage.listens) and stage.name in self.works:
                        self.works[stage.name].look_ahead(message)
                while n_frames > FRAMES_AHEAD:
                    n_frames -= isinstance(waiting[0], Frame)
                    yield waiting.popleft()
        except Exception:  # what came before it is still worked on
            yield from waiting
            raise
        yield from waiting

    def feed(self, message: Message) -> None:
        """Pass one message, and all that comes of it, through the stages that listen."""
        if not isinstance(message, Warned):
            self._t_ns = message.t_ns
        self._pass(message)
        self.collect()

    def collect(self) -> None:
        """Pass on what depth has made since; `feed` does so itself."""
        if self._depth is not None:
            fault = self._depth.fault  # which comes after the last that it has given
            while not self._depth.given.empty():
                given = self._depth.given.get()
                self._pass(given.open() if isinstance(given, Parcel) else given)
            self._warn(fault)

    def finish(self, finish: Callable[[Stage], Finish]) -> None:
        """Complete the map and the depth maps, then the results."""
        last: list[Any] = []
        saves: list[Callable[[], None]] = []
        try:
            for stage in self._stages:
                if stage.is_source and stage.name != DEPTH:
                    work, asked = self.works[stage.name], finish(stage)
                    last += work.finish(asked)
                    saves.append(partial(work.save, asked))
        finally:  # results so far are written, whatever has failed
            # before the final map comes: what it is measured by is that of its own time
            if self._depth is not None:
                self._depth.ask_to_finish(Finish(hurry=False))
                self._depth.close()
                self.collect()
            self._publish(last)
            try:
                self._finish_leaves(finish, saves)
            finally:
                self._end_processes()

    def _finish_leaves(
        self, finish: Callable[[Stage], Finish], saves: Iterable[Callable[[], None]]
    ) -> None:
        """Have the leaves finish, and sources that have finished save meanwhile."""
        leaves = [stage for stage in self._stages if not stage.is_source]
        for stage in leaves:
            if stage.name in self._processes:
                self._processes[stage.name].ask_to_finish(finish(stage))
        try:
            for save in saves:
                save()
        finally:
            for stage in leaves:
                if stage.name in self._processes:
                    self._processes[stage.name].close()
                    self._check(stage.name)
                else:
                    self.works[stage.name].finish(finish(stage))

    def _pass(self, message: Message) -> None:
        """The last stages first: an image is there before its pose."""
        if self._watch(message) is False:
            return
        parcel: Parcel | None = None
        for stage in reversed(self._stages):
            if not isinstance(message, stage.listens):
                continue
            if stage.name in self._processes:
                parcel = parcel or self._parcel_of(message)
                self._processes[stage.name].put(parcel)
                self._check(stage.name)
            elif stage.name == DEPTH and self._thread is not None:
                self._thread.put(message)
            else:
                self._publish(self.works[stage.name].step(message))

    def _parcel_of(self, message: Message) -> Parcel:
        closed = self._closed.pop(message.seq, None) if isinstance(message, Frame) else None
        return Parcel.of(message) if closed is None else closed.result()

    def _publish(self, messages: Iterable[Any]) -> None:
        for message in messages:
            self._pass(message)

    def _check(self, name: str) -> None:
        """Raise what has ended a process that is not left out."""
        fault = self._processes[name].fault
        if fault is not None and name != DEPTH:
            raise fault

    def _warn(self, fault: BaseException | None) -> None:
        """Warn once that the dense map has ended early."""
        if fault is not None and not self._fault_reported:
            self._fault_reported = True
            self._pass(Warned(self._t_ns, DEPTH_FAILED, in_words(fault)))

    def _end_processes(self) -> None:
        self._closer.shutdown(cancel_futures=True)
        for process in self._processes.values():
            process.kill()


def in_words(fault: BaseException) -> str:
    """A fault in one line: its text if raised on purpose, else its type as well."""
    text = " ".join(str(fault).split())
    if isinstance(fault, CompanionError):
        return text
    return f"{type(fault).__name__}: {text}" if text else type(fault).__name__


def in_order_of_time(telemetry: Iterable[Message], frames: Iterable[Message]) -> Iterator[Message]:
    """Merge telemetry (sorted) and frames; a frame comes after all telemetry up to its time.

    Both are sorted; Warned among the frames passes through at once.
    """
    samples = iter(telemetry)
    waiting = next(samples, None)
    for frame in frames:
        if isinstance(frame, Frame):
            while waiting is not None and waiting.t_ns <= frame.t_ns:
                yield waiting
                waiting = next(samples, None)
        yield frame
    while waiting is not None:
        yield waiting
        waiting = next(samples, None)
