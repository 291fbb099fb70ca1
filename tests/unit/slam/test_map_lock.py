"""Frames and mapping take turns as they did before, where their order is given."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from companion.messages import KeyframeAdded
from companion.slam.mapping.mapping_worker import BackgroundMapping, Done, MapLock, OrderError

N_FRAMES, EVERY = 120, 4


class Work:
    """Frames and mapping jobs that each change one number, in ways that do not commute."""

    def __init__(self, order: list[int] | None, rng: np.random.Generator) -> None:
        self.value, self.points = 1, list[int]()
        self.seen: list[int] = []
        self._rng = rng
        self._pending = 0
        self.lock = MapLock(order)
        self.worker = BackgroundMapping(self.lock, self._idle)

    def _step(self, factor: int) -> None:
        self.value = (self.value * factor + 12345) % (1 << 61)

    def _pause(self) -> None:
        time.sleep(float(self._rng.random()) * 2e-4)

    def _job(self) -> Done:
        for _ in range(6):
            self._step(31)
            self._pause()
            self.lock.yield_to_tracking()
        with self.lock.released():
            copied = self.value
            self._pause()
        self.value ^= copied
        self._pending += 1
        return list[KeyframeAdded]()  # type: ignore[return-value]

    def _idle(self, yield_point: Callable[[], None]) -> None:
        while self._pending:
            self._pending = 0
            for _ in range(5):
                self._pause()
                yield_point()
            with self.lock.mapping():
                self._step(101)

    def fly(self) -> None:
        for frame in range(N_FRAMES):
            self._pause()
            with self.lock.tracking():
                self.points.append(self.lock.point)
                self._step(7)
                self.worker.done()
                busy = self.worker.busy
                self.seen.append(self.value + busy)
                if frame % EVERY == 0 and not busy:
                    self.worker.submit(self._job)
        self.worker.close()


@pytest.mark.parametrize("n", range(3))
def test_the_same_order_gives_the_same(n: int) -> None:
    first = Work(None, np.random.default_rng(n))
    first.fly()
    assert len(set(first.points)) > 10, "mapping and frames did take turns"
    for seed in (100, 200):
        again = Work(first.points, np.random.default_rng(seed))
        again.fly()
        assert again.seen == first.seen
        assert again.points == first.points


def test_an_order_that_cannot_be_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.slam.mapping.mapping_worker.LONGEST_TURN_S", 0.05)
    lock = MapLock([3])
    with pytest.raises(OrderError, match="mapping stands at point 0"), lock.tracking():
        pass


def test_a_reader_is_no_part_of_the_order() -> None:
    lock = MapLock([0, 0])
    with lock.tracking():
        pass
    with lock.reading():
        pass
    with lock.tracking():
        pass
    done = threading.Event()

    def map_on() -> None:
        with lock.mapping():
            done.set()

    mapping = threading.Thread(target=map_on)
    mapping.start()
    assert done.wait(60)
    mapping.join()


def test_mapping_ends_where_the_frame_that_is_due_never_comes() -> None:
    """The image of a frame may be missing in a recording: that is told, not waited for."""
    lock = MapLock([1])
    worker = BackgroundMapping(lock)
    stands = threading.Event()

    def job() -> Done:
        stands.set()
        lock.yield_to_tracking()
        return list[KeyframeAdded]()  # type: ignore[return-value]

    worker.submit(job)
    assert stands.wait(60)
    closing = threading.Thread(target=worker.close)
    lock.end_order()
    closing.start()
    closing.join(60)
    assert not closing.is_alive()
    assert lock.point == 2


def test_a_frame_goes_as_soon_as_idle_work_comes_to_its_point() -> None:
    lock = MapLock([1])
    tracked = threading.Event()

    def track() -> None:
        with lock.tracking():
            tracked.set()

    frame = threading.Thread(target=track)
    frame.start()
    assert not tracked.wait(0.05), "it is not its turn"
    lock.pass_point(lambda: True)
    assert tracked.wait(60)
    frame.join()
