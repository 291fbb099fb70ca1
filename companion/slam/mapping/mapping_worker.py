"""Synchronous mapping, for results independent of timing, and mapping in a background thread."""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Protocol

from companion.errors import CompanionError
from companion.messages import KeyframeAdded, LoopClosed

Done = list[KeyframeAdded | LoopClosed]
Job = Callable[[], Done]
IdleWork = Callable[[Callable[[], None]], None]
"""Work for idle time; it calls its argument every few milliseconds."""
MAX_QUEUED = 2
LONGEST_TURN_S = 60.0
"""Longest wait of a frame for its place in a given order of mapping and frames."""


class OrderError(CompanionError):
    """The given order cannot be kept: mapping never reaches the point of a frame."""

    def __init__(self, point: int, wanted: int) -> None:
        super().__init__(f"mapping stands at point {point}, and a frame was tracked at {wanted}")


class MapLock:
    """Lock of the map with priority for tracking.

    Mapping yields where the map is consistent, so that a frame waits for at most a few
    milliseconds. Not reentrant.

    What mapping and tracking make of the map hangs on their order alone. It is counted in the
    points where mapping could have yielded: a frame is tracked at the number that `point` has then.
    With the numbers of a flight's frames as `order` they take turns as they did in that flight.
    """

    def __init__(self, order: Iterable[int] | None = None) -> None:
        self._changed = threading.Condition()
        self._wanted = self._tracking = self._mapping = False
        self._order = deque(order) if order is not None else None
        self.point = 0
        """Points that mapping has passed."""

    @contextmanager
    def tracking(self) -> Iterator[None]:
        """Hold the lock for a frame, ahead of any waiting mapping."""
        with self.reading():
            yield
            if self._order:
                self._order.popleft()

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Hold the lock likewise, to look and change nothing: no part of the order."""
        with self._changed:
            self._wanted = True
            came = self._changed.wait_for(self._may_track, LONGEST_TURN_S if self._order else None)
            if not came:
                raise OrderError(self.point, self._order[0] if self._order else 0)
            self._wanted, self._tracking = False, True
        try:
            yield
        finally:
            with self._changed:
                self._tracking = False
                self._changed.notify_all()

    @contextmanager
    def mapping(self) -> Iterator[None]:
        """Hold the lock while no frame needs it."""
        self._acquire()
        try:
            yield
        finally:
            with self._changed:
                self._mapping = False
                self._changed.notify_all()

    def yield_to_tracking(self) -> None:
        """Let a waiting frame go first; within `mapping`, without effect elsewhere."""
        if not self._mapping:
            return
        if not (self._wanted if self._order is None else self._is_turn_of_tracking()):
            self.point += 1
            return
        with self._changed:
            self._mapping = False
            self._changed.notify_all()
        self._acquire()

    @contextmanager
    def released(self) -> Iterator[None]:
        """Release the lock during long work on copies, within `mapping`; no effect elsewhere."""
        if not self._mapping:
            yield
            return
        with self._changed:
            self._mapping = False
            self._changed.notify_all()
        try:
            yield
        finally:
            self._acquire()

    def pass_point(self, look: Callable[[], bool]) -> bool:
        """Wait while a frame holds the lock, for callers that hold nothing of the map; then look.

        What frames change is seen by `look` as it was when they were over.
        """
        with self._changed:
            self._changed.wait_for(self._may_map)
            self.point += 1
            self._changed.notify_all()  # a frame may have waited for this point
            return look()

    def end_order(self) -> None:
        """No frame comes any more, also where the order has some left: mapping waits for none."""
        with self._changed:
            if self._order is not None:
                self._order.clear()
            self._changed.notify_all()

    def _acquire(self) -> None:
        with self._changed:
            self._changed.wait_for(self._may_map)
            self._mapping = True
            self.point += 1

    def _is_turn_of_tracking(self) -> bool:
        return self._order is not None and bool(self._order) and self._order[0] <= self.point

    def _may_track(self) -> bool:
        return not self._mapping and (not self._order or self._is_turn_of_tracking())

    def _may_map(self) -> bool:
        waits = self._wanted if self._order is None else self._is_turn_of_tracking()
        return not (waits or self._tracking)


class MappingWorker(Protocol):
    """Runs mapping jobs one after the other."""

    @property
    def busy(self) -> bool:
        """True if the queue is so long that another keyframe would be mapped too late."""

    def submit(self, job: Job) -> None:
        """Queue a job."""

    def done(self) -> Done:
        """Results since the last call; raises what a job raised."""

    def close(self) -> None:
        """Finish queued jobs."""


class SynchronousMapping:
    """Runs each job on submission."""

    busy = False

    def __init__(self) -> None:
        self._finished: Done = []

    def submit(self, job: Job) -> None:
        """Run the job."""
        self._finished.extend(job())

    def done(self) -> Done:
        """Results since the last call."""
        finished, self._finished = self._finished, []
        return finished

    def close(self) -> None:
        """Nothing is queued."""


class _ClosingError(Exception):
    """Aborts idle work on closing."""


class BackgroundMapping:
    """Runs jobs in a thread of its own while no frame is tracked, and `idle_work` between them."""

    def __init__(self, map_lock: MapLock, idle_work: IdleWork = lambda yield_point: None) -> None:
        self._map_lock, self._idle_work = map_lock, idle_work
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._finished: queue.SimpleQueue[Done] = queue.SimpleQueue()
        self._fault: BaseException | None = None
        self._waiting = 0
        self._thread = threading.Thread(target=self._work, name="mapping", daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """True if the queue is so long that another keyframe would be mapped too late."""
        return self._waiting >= MAX_QUEUED

    def submit(self, job: Job) -> None:
        """Queue a job."""
        self._waiting += 1
        self._jobs.put(job)

    def done(self) -> Done:
        """Results since the last call; raises what a job raised."""
        if self._fault is not None:
            raise self._fault
        out: Done = []
        while not self._finished.empty():
            out += self._finished.get()
            self._waiting -= 1
        return out

    def close(self) -> None:
        """Finish queued jobs and end the thread."""
        self._jobs.put(None)
        self._thread.join()

    def _work(self) -> None:
        try:
            while (job := self._jobs.get()) is not None:
                self._do(job)
                self._idle_work(self._yield_point)
        except _ClosingError:
            return
        except BaseException as fault:  # handed to the tracker's thread, which raises it
            self._fault = fault

    def _do(self, job: Job) -> None:
        with self._map_lock.mapping():
            self._finished.put(job())

    def _yield_point(self) -> None:
        """Let frames and jobs go before idle work, which holds nothing of the map now."""
        while self._map_lock.pass_point(lambda: not self._jobs.empty()):
            job = self._jobs.get()
            if job is None:
                raise _ClosingError
            self._do(job)
