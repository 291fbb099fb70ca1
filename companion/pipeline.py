"""The stages in their order, and the two ways to run them.

| stage        | listens to                           | gives                           |
|--------------|--------------------------------------|---------------------------------|
| localisation | telemetry, Frame                     | Track, KeyframeAdded, MapUpdate |
| depth        | Frame, Track, KeyframeAdded, MapUpdate | DepthMap, PointChunk          |
| sinks        | all of it                            |                                 |

Localisation runs in the caller's thread; depth in one of its own, fed in order through a bounded
queue. In lockstep the queue makes the caller wait and nothing is lost, so that the results do not
depend on anybody's speed. Live, a full queue turns a keyframe's depth away, never a pose.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterable, Iterator
from typing import Protocol

from companion.localisation import LocalisationStage
from companion.messages import (
    Frame,
    KeyframeAdded,
    MapUpdate,
    Message,
    Track,
    Warned,
)

DEPTH_QUEUE = 64


class Stage(Protocol):
    """Messages in, messages out; its own state, nobody else's."""

    def step(self, message: Message) -> list[Message]:
        """Take one message."""

    def flush(self) -> list[Message]:
        """Finish what is still open."""


class Sink(Protocol):
    """Where messages leave the pipeline."""

    def take(self, message: Message) -> None:
        """Take one message; must not take long."""


class StageThread:
    """A stage in its own thread; its results wait until they are collected."""

    def __init__(self, stage: Stage, lossless: bool) -> None:
        self._stage = stage
        self._lossless = lossless
        self._inbox: queue.Queue[Message | None] = queue.Queue(DEPTH_QUEUE)
        self._outbox: queue.SimpleQueue[Message] = queue.SimpleQueue()
        self._fault: BaseException | None = None
        self.n_dropped = 0
        self._thread = threading.Thread(target=self._work, name="depth", daemon=True)
        self._thread.start()

    def put(self, message: Message) -> None:
        """Hand over a message; waits for room in lockstep, else drops frames and keyframes."""
        if self._fault is not None:
            raise self._fault
        if self._lossless or not isinstance(message, Frame):
            self._inbox.put(message)
        elif self._inbox.qsize() < DEPTH_QUEUE // 2:
            self._inbox.put(message)
        else:
            self.n_dropped += 1

    def collect(self) -> Iterator[Message]:
        """Results so far."""
        while True:
            try:
                yield self._outbox.get_nowait()
            except queue.Empty:
                return

    def close(self) -> Iterator[Message]:
        """Finish, and yield the last results; raises what the stage raised."""
        self._inbox.put(None)
        self._thread.join()
        yield from self.collect()
        if self._fault is not None:
            raise self._fault

    def _work(self) -> None:
        try:
            while (message := self._inbox.get()) is not None:
                for out in self._stage.step(message):
                    self._outbox.put(out)
            for out in self._stage.flush():
                self._outbox.put(out)
        except BaseException as fault:  # handed to the caller's thread, which raises it
            self._fault = fault
            while self._inbox.get() is not None:
                pass


class Pipeline:
    """The stages joined; feed it messages in order of time."""

    def __init__(
        self,
        localisation: LocalisationStage,
        depth: Stage | None,
        sinks: Iterable[Sink],
        lossless: bool,
    ) -> None:
        self._localisation = localisation
        self._depth = StageThread(depth, lossless) if depth is not None else None
        self._sinks = list(sinks)

    @property
    def state(self) -> str:
        """The tracker's state in a word."""
        return self._localisation.state.value

    @property
    def n_depth_frames_dropped(self) -> int:
        """Frames that the depth stage had no time for (never in lockstep)."""
        return self._depth.n_dropped if self._depth is not None else 0

    def feed(self, message: Message) -> None:
        """Take one message through all stages."""
        self._publish(message)
        if isinstance(message, Warned):
            return
        if isinstance(message, Frame) and self._depth is not None:
            self._depth.put(message)
        for out in self._localisation.step(message):
            self._pass_on(out)
        if self._depth is not None:
            for out in self._depth.collect():
                self._publish(out)

    def finish(self) -> None:
        """Adjust the map, complete the depth, and pass on the rest."""
        last = self._localisation.finish()
        if self._depth is not None:
            for out in self._depth.close():
                self._publish(out)
            self._depth = None
        for out in last:
            self._publish(out)

    def _pass_on(self, message: Message) -> None:
        if self._depth is not None and isinstance(message, (Track, KeyframeAdded, MapUpdate)):
            self._depth.put(message)
        self._publish(message)

    def _publish(self, message: Message) -> None:
        for sink in self._sinks:
            sink.take(message)


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
