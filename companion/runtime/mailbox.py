"""Message queue of bounded size: on overflow messages are dropped by kind, and counted.

Or, where all are wanted, whoever has another waits for room.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable
from enum import IntEnum
from typing import Generic, TypeVar

T = TypeVar("T")


class DropPolicy(IntEnum):
    """Treatment of a waiting message on overflow: the lowest kind is dropped first."""

    LATEST_WINS = 0
    """Replaced by the next of its kind, even without overflow."""
    PICTURE = 1
    """Large, and one of many: the oldest is dropped first."""
    MAP = 2
    """Part of the map: the oldest is dropped when no PICTURE is left."""
    LOSSLESS = 3
    """Small: the oldest is dropped when nothing else is left."""
    ALWAYS = 4
    """Control message: never dropped."""


GATHERED = DropPolicy.LOSSLESS
"""Messages that may be let gather, and be taken out together."""


class Mailbox(Generic[T]):
    """Queue of messages, at most `capacity_bytes` of them; may be used from any thread.

    A message larger than that is let in when nothing else is there that could be dropped. With
    `waits` nothing is dropped: `put` waits for room.
    """

    def __init__(
        self,
        policy_of: Callable[[T], DropPolicy],
        bytes_of: Callable[[T], int],
        capacity_bytes: int,
        waits: bool = False,
    ) -> None:
        self._policy_of, self._bytes_of = policy_of, bytes_of
        self._capacity_bytes, self._is_lossless = capacity_bytes, waits
        self._waiting: dict[DropPolicy, deque[tuple[int, int, T]]] = {
            policy: deque() for policy in DropPolicy
        }
        """By policy: arrival number, size in bytes, message."""
        self._n_put = 0
        self._closed = False
        self._waits = self._pauses = False
        """True while `collect` waits; while it lets small messages gather, and is not woken."""
        self._gather_bytes = 0
        self._changed = threading.Condition()
        self.n_bytes = 0
        """Size of the waiting messages."""
        self.n_dropped = 0
        """Frames replaced by a newer one."""
        self.n_overflowed = 0
        """Other messages dropped on overflow."""

    def put(self, message: T) -> None:
        """Add a message; see `waits`. Counted as dropped once it is closed."""
        self.put_all((message,))

    def put_all(self, messages: Iterable[T]) -> None:
        """As `put` of each; whoever waits for them is woken once."""
        with self._changed:
            for message in messages:
                self._put(message)
            if not self._pauses or self._is_urgent():
                self._changed.notify_all()

    def get(self) -> T | None:
        """Oldest message; waits for one. None once it is closed and empty."""
        return next(iter(self.collect(-1, 0.0)), None)

    def collect(self, most_bytes: int, pause_s: float) -> list[T]:
        """Oldest message; LOSSLESS ones in a row together, up to `most_bytes`. Waits for one.

        Where nothing waits, LOSSLESS ones are let gather for `pause_s`, or until they are more
        than `most_bytes`: waking a thread for each costs more than sending it. Empty once it is
        closed and empty.
        """
        with self._changed:
            self._gather_bytes = most_bytes
            self._waits = not self._has_any()
            if self._waits and pause_s:
                self._pauses = True
                self._changed.wait_for(self._is_urgent, pause_s)
                self._pauses = False
            self._changed.wait_for(lambda: self._closed or self._has_any())
            self._waits = False
            taken: list[T] = []
            n_bytes = 0
            while self._has_any():
                policy = self._oldest()
                _, size, message = self._waiting[policy][0]
                n_bytes += size
                if taken and (policy is not GATHERED or n_bytes > most_bytes):
                    break
                self._drop(policy)
                taken.append(message)
                if policy is not GATHERED:
                    break
            if self._is_lossless:
                self._changed.notify_all()
            return taken

    @property
    def is_idle(self) -> bool:
        """True if nothing waits here, and whoever took the last message is ready for another.

        It remains so as long as nothing is put.
        """
        return self._waits and not self._closed and not self._has_any()

    def close(self) -> None:
        """End input; waiting messages can still be taken out."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _put(self, message: T) -> None:
        policy, size = self._policy_of(message), self._bytes_of(message)
        if self._is_lossless and not self._has_room(size):
            self._changed.notify_all()  # of those before it
            self._changed.wait_for(lambda: self._closed or self._has_room(size))
        if self._closed:
            self.n_overflowed += 1
            return
        if policy is DropPolicy.LATEST_WINS and self._waiting[policy]:
            self._drop(policy)
            self.n_dropped += 1
        self._waiting[policy].append((self._n_put, size, message))
        self._n_put += 1
        self.n_bytes += size
        while self.n_bytes > self._capacity_bytes and self._drop_lowest():
            self.n_overflowed += 1

    def _has_room(self, size: int) -> bool:
        return not self.n_bytes or self.n_bytes + size <= self._capacity_bytes

    def _has_any(self) -> bool:
        return any(self._waiting.values())

    def _is_urgent(self) -> bool:
        """True if there is more than a few small messages."""
        return (
            self._closed
            or self.n_bytes > self._gather_bytes
            or any(held for policy, held in self._waiting.items() if policy is not GATHERED)
        )

    def _oldest(self) -> DropPolicy:
        """Policy of the oldest message."""
        return min((held[0][0], policy) for policy, held in self._waiting.items() if held)[1]

    def _drop_lowest(self) -> bool:
        """Drop a message, but not the newest; whether there was one to drop."""
        for policy in (DropPolicy.PICTURE, DropPolicy.MAP, DropPolicy.LOSSLESS):
            if self._waiting[policy] and self._waiting[policy][0][0] < self._n_put - 1:
                self._drop(policy)
                return True
        return False

    def _drop(self, policy: DropPolicy) -> None:
        self.n_bytes -= self._waiting[policy].popleft()[1]
