"""Queue of messages for a viewer, bounded in bytes."""

from __future__ import annotations

import threading
from collections import deque

from companion.runtime.message_size import size_bytes
from companion.streaming.scene_encoder import Watched


class Inbox:
    """Queue of messages between threads, at most `capacity_bytes` of them.

    A message larger than that is let in when nothing else is there.
    """

    def __init__(self, capacity_bytes: int) -> None:
        self._capacity_bytes = capacity_bytes
        self._held: deque[tuple[Watched, int]] = deque()
        self._bytes = 0
        self._closed = False
        self._changed = threading.Condition()

    def put(self, message: Watched) -> None:
        """Add a message; waits for capacity. Ignored once the inbox is closed."""
        size = size_bytes(message)
        with self._changed:
            self._changed.wait_for(
                lambda: self._closed or not self._held or self._bytes + size <= self._capacity_bytes
            )
            if not self._closed:
                self._held.append((message, size))
                self._bytes += size
                self._changed.notify_all()

    def get(self) -> Watched | None:
        """Oldest message; waits for one. None once it is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or bool(self._held))
            if not self._held:
                return None
            message, size = self._held.popleft()
            self._bytes -= size
            self._changed.notify_all()
            return message

    def close(self) -> None:
        """End input; waiting messages can still be taken out."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
