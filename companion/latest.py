"""A queue in which only the latest frame waits: work that is behind skips frames, nothing else."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class LatestWins(Generic[T]):
    """Messages in order; a frame takes the place of one that still waits, which is counted.

    What is no frame is never dropped, unless more than `most` waits: then the oldest goes, counted
    too.
    """

    def __init__(self, is_frame: Callable[[T], bool], most: int = 20_000) -> None:
        self._is_frame = is_frame
        self._most = most
        self._waiting: deque[T] = deque()
        self._closed = False
        self._changed = threading.Condition()
        self.n_dropped = 0
        """Frames passed over."""
        self.n_overflown = 0
        """Other messages given up."""

    def put(self, message: T) -> None:
        """Add a message; never waits."""
        with self._changed:
            if self._is_frame(message):
                old = next((m for m in self._waiting if self._is_frame(m)), None)
                if old is not None:
                    self._waiting.remove(old)
                    self.n_dropped += 1
            elif len(self._waiting) >= self._most:
                self._waiting.popleft()
                self.n_overflown += 1
            self._waiting.append(message)
            self._changed.notify()

    def get(self) -> T | None:
        """The oldest message; waits for one. None once it is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or bool(self._waiting))
            return self._waiting.popleft() if self._waiting else None

    def close(self) -> None:
        """No more comes; what is there can still be taken out."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
