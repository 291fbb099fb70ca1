"""A queue of messages of bounded size: where room is short they go by kind, and are counted."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from enum import IntEnum
from typing import Generic, TypeVar

T = TypeVar("T")


class Fate(IntEnum):
    """What becomes of a message that waits. Where room is short the lowest kind goes first."""

    LATEST_WINS = 0
    """It gives way to the next of its kind, whether room is short or not."""
    PICTURE = 1
    """Large, and one of many: the oldest goes."""
    MAP = 2
    """Part of the map: the oldest goes when there is no picture left."""
    LOSSLESS = 3
    """Small: the oldest goes when there is nothing else left."""
    ALWAYS = 4
    """What a stage is told to do: it stays."""


class Mailbox(Generic[T]):
    """Messages in order, `room_bytes` of them at most; may be used from any thread.

    A message that is larger than the room is let in when nothing else is there that could go.
    """

    def __init__(
        self, fate_of: Callable[[T], Fate], bytes_of: Callable[[T], int], room_bytes: int
    ) -> None:
        self._fate_of, self._bytes_of, self._room_bytes = fate_of, bytes_of, room_bytes
        self._waiting: dict[Fate, deque[tuple[int, int, T]]] = {fate: deque() for fate in Fate}
        """by fate: how many came before it, its bytes, the message"""
        self._n_put = 0
        self._closed = False
        self._changed = threading.Condition()
        self.n_bytes = 0
        """Of what waits."""
        self.n_dropped = 0
        """Frames that gave way to a newer one."""
        self.n_overflown = 0
        """Other messages given up for want of room."""

    def __len__(self) -> int:
        with self._changed:
            return sum(map(len, self._waiting.values()))

    def put(self, message: T) -> None:
        """Add a message; never waits."""
        fate, size = self._fate_of(message), self._bytes_of(message)
        with self._changed:
            if fate is Fate.LATEST_WINS and self._waiting[fate]:
                self._drop(fate)
                self.n_dropped += 1
            self._waiting[fate].append((self._n_put, size, message))
            self._n_put += 1
            self.n_bytes += size
            while self.n_bytes > self._room_bytes and self._make_room():
                self.n_overflown += 1
            self._changed.notify()

    def get(self) -> T | None:
        """The oldest message; waits for one. None once it is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or any(self._waiting.values()))
            heads = [held[0] for held in self._waiting.values() if held]
            if not heads:
                return None
            oldest = min(heads, key=lambda head: head[0])
            self._drop(next(f for f, held in self._waiting.items() if held and held[0] is oldest))
            return oldest[2]

    def close(self) -> None:
        """No more comes; what is there can still be taken out."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _make_room(self) -> bool:
        """Give up a message, but not the one that came last; whether there was one to give up."""
        for fate in (Fate.PICTURE, Fate.MAP, Fate.LOSSLESS):
            if self._waiting[fate] and self._waiting[fate][0][0] < self._n_put - 1:
                self._drop(fate)
                return True
        return False

    def _drop(self, fate: Fate) -> None:
        self.n_bytes -= self._waiting[fate].popleft()[1]
