"""Where mapping runs: at once, so that results do not depend on speed, or beside the tracking."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from companion.messages import KeyframeAdded, LoopClosed

Done = list[KeyframeAdded | LoopClosed]
Job = Callable[[], Done]
Spare = Callable[[Callable[[], None]], None]
"""Work for when there is no other; it calls what it is given every few milliseconds."""
MAX_WAITING = 2


class MapTurn:
    """Whose turn it is to touch the map: the tracker's whenever it wants, else the mapper's.

    The mapper gives way at places where the map is whole, so that a frame waits for a few
    milliseconds of mapping at most. Not reentrant.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._wanted = self._tracking = self._mapping = False

    @contextmanager
    def tracking(self) -> Iterator[None]:
        """Have the map for a frame; comes before any mapping that waits."""
        with self._changed:
            self._wanted = True
            self._changed.wait_for(lambda: not self._mapping)
            self._wanted, self._tracking = False, True
        try:
            yield
        finally:
            with self._changed:
                self._tracking = False
                self._changed.notify_all()

    @contextmanager
    def mapping(self) -> Iterator[None]:
        """Have the map while no frame needs it."""
        self._take()
        try:
            yield
        finally:
            with self._changed:
                self._mapping = False
                self._changed.notify_all()

    def give_way(self) -> None:
        """Let a frame that waits go first; for use within `mapping`, nothing outside of it."""
        if self._wanted and self._mapping:
            with self._changed:
                self._mapping = False
                self._changed.notify_all()
            self._take()

    @contextmanager
    def away(self) -> Iterator[None]:
        """Let the map go for a longer while, within `mapping`; without effect outside of it."""
        if not self._mapping:
            yield
            return
        with self._changed:
            self._mapping = False
            self._changed.notify_all()
        try:
            yield
        finally:
            self._take()

    def pause(self) -> None:
        """Wait while a frame has the map; for who has nothing of it in hand."""
        if self._wanted or self._tracking:
            with self._changed:
                self._changed.wait_for(lambda: not (self._wanted or self._tracking))

    def _take(self) -> None:
        with self._changed:
            self._changed.wait_for(lambda: not (self._wanted or self._tracking))
            self._mapping = True


class MappingWorker(Protocol):
    """Runs one mapping job after the other."""

    @property
    def busy(self) -> bool:
        """Whether so much waits that another keyframe would come too late to be of use."""

    def submit(self, job: Job) -> None:
        """Have a job done."""

    def done(self) -> Done:
        """What was finished since the last call; raises what a job raised."""

    def close(self) -> None:
        """Finish what waits."""


class AtOnce:
    """Does each job while it is handed in."""

    busy = False

    def __init__(self) -> None:
        self._finished: Done = []

    def submit(self, job: Job) -> None:
        """Do it."""
        self._finished.extend(job())

    def done(self) -> Done:
        """What was finished since the last call."""
        finished, self._finished = self._finished, []
        return finished

    def close(self) -> None:
        """Nothing waits."""


class _ClosingError(Exception):
    """Spare work is given up for the end."""


class Beside:
    """Does the jobs in a thread of its own, in the tracker's pauses, and `spare` between them."""

    def __init__(self, turn: MapTurn, spare: Spare = lambda meanwhile: None) -> None:
        self._turn, self._spare = turn, spare
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._finished: queue.SimpleQueue[Done] = queue.SimpleQueue()
        self._fault: BaseException | None = None
        self._waiting = 0
        self._thread = threading.Thread(target=self._work, name="mapping", daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """Whether so much waits that another keyframe would come too late to be of use."""
        return self._waiting >= MAX_WAITING

    def submit(self, job: Job) -> None:
        """Queue a job."""
        self._waiting += 1
        self._jobs.put(job)

    def done(self) -> Done:
        """What was finished since the last call; raises what a job raised."""
        if self._fault is not None:
            raise self._fault
        out: Done = []
        while not self._finished.empty():
            out += self._finished.get()
            self._waiting -= 1
        return out

    def close(self) -> None:
        """Finish what waits, and end the thread."""
        self._jobs.put(None)
        self._thread.join()

    def _work(self) -> None:
        try:
            while (job := self._jobs.get()) is not None:
                self._do(job)
                self._spare(self._meanwhile)
        except _ClosingError:
            return
        except BaseException as fault:  # handed to the tracker's thread, which raises it
            self._fault = fault

    def _do(self, job: Job) -> None:
        with self._turn.mapping():
            self._finished.put(job())

    def _meanwhile(self) -> None:
        """Let frames and jobs go before spare work, which touches nothing of the map now."""
        self._turn.pause()
        while not self._jobs.empty():
            job = self._jobs.get()
            if job is None:
                raise _ClosingError
            self._do(job)
            self._turn.pause()
