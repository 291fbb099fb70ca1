"""Prefetch of an iterator's next items in a thread."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterable, Iterator
from typing import Generic, TypeVar

T = TypeVar("T")


class _Ended:
    def __init__(self, error: BaseException | None) -> None:
        self.error = error


class Prefetch(Generic[T]):
    """Iterates over `source` in a thread of its own, at most `depth` items ahead of the consumer.

    An error in the source is raised where its item would have come. The thread ends when the source
    does, on `close()`, and when a consumer's loop over a generator made from this is left.
    """

    def __init__(self, source: Iterable[T], depth: int) -> None:
        self._queue: queue.Queue[T | _Ended] = queue.Queue(depth)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(source,), daemon=True)
        self._thread.start()

    def __iter__(self) -> Iterator[T]:
        while True:
            item = self._queue.get()
            if isinstance(item, _Ended):
                self._thread.join()
                if item.error is not None:
                    raise item.error
                return
            yield item

    def close(self) -> None:
        """Stop the thread and wait for it; the present item is finished first."""
        self._stop.set()
        self._thread.join()

    def _run(self, source: Iterable[T]) -> None:
        error: BaseException | None = None
        iterator = iter(source)
        try:
            for item in iterator:
                if not self._put(item):
                    break
        except BaseException as raised:  # handed over to the consumer, whatever it is
            error = raised
        finally:
            closing = getattr(iterator, "close", None)
            if closing is not None:
                closing()
        self._put(_Ended(error))

    def _put(self, item: T | _Ended) -> bool:
        while not self._stop.is_set():
            try:
                self._queue.put(item, timeout=0.1)
            except queue.Full:
                continue
            return True
        return False
