"""Stages of one flight in one process: each message goes through all of them before the next.

Nothing is lost, and results do not depend on anybody's speed. Localisation works in the caller's
thread; where frames to come are known (`looked_ahead`), their features are extracted beside. Depth,
to which no stage above it listens, has a thread of its own, fed in order through a bounded queue
that makes the caller wait. Stages that are `forked` do their work in processes, which such threads
feed. A depth stage that fails is left out from there on: trajectory, map and the cloud so far stay.
"""

from __future__ import annotations

import os
import queue
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any

from companion.errors import CompanionError
from companion.messages import Frame, Message, Warned
from companion.runtime.forked_work import ForkedWork
from companion.runtime.message_size import size_bytes
from companion.runtime.stage_protocol import Finish, Remark, Setup
from companion.runtime.stage_work import Work, module_of
from companion.runtime.stages import Stage
from companion.telemetry import TELEMETRY

DEPTH_QUEUE, DEPTH_QUEUE_BYTES = 64, 128 << 20
"""Capacity of the queue to depth, in messages and bytes."""
DEPTH_FAILED = "the dense map ends here: the depth stage has failed"
DEPTH = "depth"
APART_NICE = 10
"""Of its thread: beside nice 0 it gets a tenth of a core that both want, and all that is left."""
MOST_SAMPLES = 256
FRAMES_AHEAD = 4
"""A keyframe takes as long as the features of some frames."""


class InOrder:
    """The given stages; feed it messages in order of time.

    `watch` sees every message; one for which it gives False goes no further. `say` takes remarks of
    the stages. Stages named in `forked`, depth or what is no source, get processes where this has
    one thread only. CompanionError where a stage cannot begin.
    """

    def __init__(
        self, stages: Iterable[Stage], setup: Setup, watch: Callable[[Message], object],
        say: Callable[[str], None], forked: Collection[str] = (),
    ) -> None:  # fmt: skip
        self._watch = watch
        self._stages = list(stages)
        self.works: dict[str, Work] = {}

        def tell(told: Any) -> None:
            if isinstance(told, Remark):
                say(told.text)

        self._apart: dict[str, _Apart] = {}
        can_fork = len(os.listdir("/proc/self/task")) == 1
        for stage in self._stages:
            if stage.name in forked and can_fork:
                self.works[stage.name] = ForkedWork(stage.name, setup, APART_NICE)
        for stage in self._stages:
            if stage.name not in self.works:
                self.works[stage.name] = module_of(stage.name).work(setup)
            work = self.works[stage.name]
            if stage.name == DEPTH or isinstance(work, ForkedWork):
                self._apart[stage.name] = _Apart(stage.name, work, tell)
            else:
                work.begin(tell)
        self._depth = self._apart.get(DEPTH)
        self._fault_reported = False
        self._t_ns = 0

    @property
    def depth_fault(self) -> BaseException | None:
        """Exception of the depth stage; None without one."""
        return self._depth.fault if self._depth is not None else None

    @property
    def times(self) -> dict[str, Mapping[str, float]]:
        """Times of all stages, by name of the work."""
        times = {k: v for work in self.works.values() for k, v in work.times.summary().items()}
        return dict(sorted(times.items()))

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
                for stage in self._stages:
                    if isinstance(message, stage.listens) and stage.name != DEPTH:
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
            self._publish(self._depth.collect())
            self._warn_fault()

    def finish(self, finish: Callable[[Stage], Finish]) -> None:
        """Complete the map and the depth maps, then the results."""
        last: list[Any] = []
        try:
            for stage in self._stages:
                if stage.is_source and stage.name != DEPTH:
                    last += self.works[stage.name].finish(finish(stage))
        finally:  # results so far are written, whatever has failed
            # before the final map comes: what it is measured by is that of its own time
            if self._depth is not None:
                self._publish(self._depth.close(Finish(hurry=False)))
                self._warn_fault()
            self._publish(last)
            for stage in self._stages:
                if stage.name in self._apart and not stage.is_source:
                    self._apart[stage.name].close(finish(stage))
                    self._check(self._apart[stage.name])
                elif not stage.is_source:
                    self.works[stage.name].finish(finish(stage))

    def _pass(self, message: Message) -> None:
        """The last stages first: an image is there before its pose."""
        if self._watch(message) is False:
            return
        for stage in reversed(self._stages):
            if not isinstance(message, stage.listens):
                continue
            if stage.name in self._apart:
                self._apart[stage.name].put(message)
                self._check(self._apart[stage.name])
            else:
                self._publish(self.works[stage.name].step(message))

    def _publish(self, messages: Iterable[Any]) -> None:
        for message in messages:
            self._pass(message)

    def _check(self, apart: _Apart) -> None:
        """Raise what has ended a stage that is not left out."""
        if apart.fault is not None and apart is not self._depth:
            raise apart.fault

    def _warn_fault(self) -> None:
        """Warn once that the dense map has ended early."""
        fault = self.depth_fault
        if fault is not None and not self._fault_reported:
            self._fault_reported = True
            self._pass(Warned(self._t_ns, DEPTH_FAILED, in_words(fault)))


class _Apart:
    """A stage in its own thread, which begins it; its results wait until they are collected.

    The path waits for nobody but for whom it needs: this thread, and those that drivers start from
    it, run at a lower priority. A stage that raises ends: later messages are ignored, earlier
    results can still be collected, and `fault` is the exception.
    """

    def __init__(self, name: str, work: Work, tell: Callable[[Any], None]) -> None:
        self._work, self._tell = work, tell
        self._inbox: queue.Queue[list[Message] | Finish] = queue.Queue(DEPTH_QUEUE)
        self._samples: list[Message] = []
        """Samples that go with the next message: waking the thread takes longer than they do."""
        self._outbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._n_bytes = 0
        self._taken = threading.Condition()
        self._is_open = True
        self._has_begun = threading.Event()
        self.fault: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()
        self._has_begun.wait()
        if self.fault is not None:
            raise self.fault

    def put(self, message: Message) -> None:
        """Pass a message; waits for room. Ignored once it is closed."""
        if not self._is_open:
            return
        self._samples.append(message)
        if isinstance(message, TELEMETRY) and len(self._samples) < MOST_SAMPLES:
            return
        messages, self._samples = self._samples, []
        size = size_bytes(message)
        with self._taken:
            self._taken.wait_for(
                lambda: not self._n_bytes or self._n_bytes + size <= DEPTH_QUEUE_BYTES
            )
            self._n_bytes += size
        self._inbox.put(messages)

    def collect(self) -> Iterator[Any]:
        """Results so far."""
        while True:
            try:
                yield self._outbox.get_nowait()
            except queue.Empty:
                return

    def close(self, finish: Finish) -> list[Any]:
        """Finish; the last results."""
        self._is_open = False
        for last in self._samples, finish:
            self._inbox.put(last)
        self._thread.join()
        return list(self.collect())

    def _run(self) -> None:
        is_open = True
        os.nice(APART_NICE)
        try:
            self._work.begin(self._tell)
        except BaseException as fault:
            self.fault = fault
            return
        finally:
            self._has_begun.set()
        try:
            while not isinstance(taken := self._take(), Finish):
                for message in taken:
                    for out in self._work.step(message):
                        self._outbox.put(out)
            is_open = False
            for out in self._work.finish(taken):
                self._outbox.put(out)
        except BaseException as fault:  # raised or reported in the caller's thread
            self.fault = fault
        while is_open and not isinstance(self._take(), Finish):
            pass  # so that `put` does not wait for ever

    def _take(self) -> list[Message] | Finish:
        taken = self._inbox.get()
        if self._is_open and not isinstance(taken, Finish):
            with self._taken:
                self._n_bytes -= size_bytes(taken[-1])
                self._taken.notify()
        return taken


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
