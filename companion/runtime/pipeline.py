"""In-process pipeline of the stages, in lockstep or live.

| stage        | listens to                           | gives                           |
|--------------|--------------------------------------|---------------------------------|
| localisation | telemetry, Frame                     | Track, KeyframeAdded, MapUpdate |
| depth        | Frame, Track, KeyframeAdded, MapUpdate | DepthMap, PointChunk          |
| sinks        | all of it                            |                                 |

Localisation runs in the caller's thread; depth in one of its own, fed in order through a bounded
queue. In lockstep the queue makes the caller wait and nothing is lost, so that the results do not
depend on anybody's speed. Live, a full queue turns a keyframe's depth away, never a pose. A depth
stage that fails is left out from there on: trajectory, map and what there is of the cloud stay.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterable, Iterator
from typing import Protocol

from companion.errors import CompanionError
from companion.estimation.localisation import LocalisationStage
from companion.messages import (
    Frame,
    KeyframeAdded,
    MapUpdate,
    Message,
    Track,
    Warned,
)
from companion.runtime.message_size import size_bytes

DEPTH_QUEUE, DEPTH_QUEUE_BYTES = 64, 128 << 20
"""Capacity of the queue to depth, in messages and bytes."""
DEPTH_FAILED = "the dense map ends here: the depth stage has failed"


class Stage(Protocol):
    """Messages in, messages out; owns its state."""

    def step(self, message: Message) -> list[Message]:
        """Take one message."""

    def flush(self) -> list[Message]:
        """Finish open work."""


class Sink(Protocol):
    """Consumer of all messages of the pipeline."""

    def take(self, message: Message) -> None:
        """Take one message; must not take long."""


class StageThread:
    """A stage in its own thread; its results wait until they are collected.

    A stage that raises ends: later messages are ignored, earlier results can still be collected,
    and `fault` is the exception.
    """

    def __init__(self, stage: Stage, lossless: bool) -> None:
        self._stage = stage
        self._lossless = lossless
        self._inbox: queue.Queue[Message | None] = queue.Queue(DEPTH_QUEUE)
        self._outbox: queue.SimpleQueue[Message] = queue.SimpleQueue()
        self._n_bytes = 0
        self._taken = threading.Condition()
        self.fault: BaseException | None = None
        """Exception of the stage; None while it works."""
        self.n_dropped = 0
        self._thread = threading.Thread(target=self._work, name="depth", daemon=True)
        self._thread.start()

    def put(self, message: Message) -> None:
        """Pass a message; in lockstep waits for capacity, else drops frames and keyframes."""
        size = size_bytes(message)
        with self._taken:
            fits = not self._n_bytes or self._n_bytes + size <= DEPTH_QUEUE_BYTES
            if not self._lossless and isinstance(message, Frame):
                if not fits or self._inbox.qsize() >= DEPTH_QUEUE // 2:
                    self.n_dropped += 1
                    return
            elif not fits:
                self._taken.wait_for(
                    lambda: not self._n_bytes or self._n_bytes + size <= DEPTH_QUEUE_BYTES
                )
            self._n_bytes += size
        self._inbox.put(message)

    def collect(self) -> Iterator[Message]:
        """Results so far."""
        while True:
            try:
                yield self._outbox.get_nowait()
            except queue.Empty:
                return

    def close(self) -> Iterator[Message]:
        """Finish, and yield the last results."""
        self._inbox.put(None)
        self._thread.join()
        yield from self.collect()

    def _work(self) -> None:
        is_open = True
        try:
            while (message := self._take()) is not None:
                for out in self._stage.step(message):
                    self._outbox.put(out)
            is_open = False
            for out in self._stage.flush():
                self._outbox.put(out)
        except BaseException as fault:  # handed to the caller's thread, which tells of it
            self.fault = fault
        while is_open and self._take() is not None:
            pass  # whoever puts must not wait for ever

    def _take(self) -> Message | None:
        message = self._inbox.get()
        if message is not None:
            with self._taken:
                self._n_bytes -= size_bytes(message)
                self._taken.notify()
        return message


class Pipeline:
    """The joined stages; feed it messages in order of time."""

    def __init__(
        self,
        localisation: LocalisationStage,
        depth: Stage | None,
        sinks: Iterable[Sink],
        lossless: bool,
    ) -> None:
        self._localisation = localisation
        self._depth = StageThread(depth, lossless) if depth is not None else None
        self._fault_reported = False
        self._sinks = list(sinks)
        self._t_ns = 0

    @property
    def state(self) -> str:
        """Tracking state as a word."""
        return self._localisation.state.value

    @property
    def depth_fault(self) -> BaseException | None:
        """Exception of the depth stage; None without one."""
        return self._depth.fault if self._depth is not None else None

    @property
    def n_depth_frames_dropped(self) -> int:
        """Frames dropped by the depth stage (never in lockstep)."""
        return self._depth.n_dropped if self._depth is not None else 0

    def feed(self, message: Message) -> None:
        """Pass one message through all stages."""
        self._publish(message)
        if isinstance(message, Warned):
            return
        self._t_ns = message.t_ns
        if isinstance(message, Frame) and self._depth is not None:
            self._depth.put(message)
        for out in self._localisation.step(message):
            self._pass_on(out)
        if self._depth is not None:
            for out in self._depth.collect():
                self._publish(out)
            self._warn_fault()

    def finish(self) -> None:
        """Final adjustment of the map, complete the depth maps, publish the rest."""
        try:
            last = self._localisation.finish()
        finally:
            if self._depth is not None:
                for out in self._depth.close():
                    self._publish(out)
                self._warn_fault()
        for out in last:
            self._publish(out)

    def _warn_fault(self) -> None:
        """Warn once that the dense map has ended early."""
        fault = self.depth_fault
        if fault is not None and not self._fault_reported:
            self._fault_reported = True
            self._publish(Warned(self._t_ns, DEPTH_FAILED, in_words(fault)))

    def _pass_on(self, message: Message) -> None:
        if self._depth is not None and isinstance(message, (Track, KeyframeAdded, MapUpdate)):
            self._depth.put(message)
        self._publish(message)

    def _publish(self, message: Message) -> None:
        for sink in self._sinks:
            sink.take(message)


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
