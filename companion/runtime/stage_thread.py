"""A stage in a thread of its own, fed in order through a queue that makes the caller wait."""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Callable, Iterator
from typing import Any

from companion.messages import Message
from companion.runtime.message_size import size_bytes
from companion.runtime.stage_protocol import Finish, Progress
from companion.runtime.stage_work import Work
from companion.runtime.stages import NICE_WITHOUT_LOSS
from companion.telemetry import TELEMETRY

ROOM, ROOM_BYTES = 64, 128 << 20
"""Capacity of the queue, in messages and bytes."""
MOST_SAMPLES = 256


class StageThread:
    """A stage that is begun in its thread; its results wait until they are collected.

    The path waits for nobody but for whom it needs: this thread, and those that drivers start from
    it, run at a lower priority. A stage that raises ends: later messages are ignored, earlier
    results can still be collected, and `fault` is the exception.
    """

    def __init__(self, name: str, work: Work, tell: Callable[[Any], None]) -> None:
        self._work, self._tell = work, tell
        self._inbox: queue.Queue[list[Message] | Finish] = queue.Queue(ROOM)
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

    @property
    def progress(self) -> Progress:
        """Progress now."""
        return self._work.progress

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
            self._taken.wait_for(lambda: not self._n_bytes or self._n_bytes + size <= ROOM_BYTES)
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
        os.nice(NICE_WITHOUT_LOSS)
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
