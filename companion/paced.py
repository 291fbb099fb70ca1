"""A recorded flight in its own time, with the drops of a live one.

A frame that comes while the last is still being worked on takes the place of any other that waits:
the latest wins and the rest are counted. Telemetry is never dropped.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable, Iterator

from companion.clock import monotonic_s, wait_s
from companion.messages import Frame, Message


class PacedFeed:
    """Plays messages at the times they carry; iterate over it in the working thread."""

    def __init__(self, messages: Iterable[Message], speed: float = 1.0) -> None:
        self._messages = messages
        self._speed = speed
        self._waiting: deque[Message] = deque()
        self._frame_waits = False
        self._done = False
        self._stop = threading.Event()
        self._fault: BaseException | None = None
        self._changed = threading.Condition()
        self.n_dropped = 0

    def __iter__(self) -> Iterator[Message]:
        player = threading.Thread(target=self._play, name="paced", daemon=True)
        player.start()
        try:
            while True:
                with self._changed:
                    while not self._waiting and not self._done:
                        self._changed.wait()
                    if not self._waiting:
                        break
                    message = self._waiting.popleft()
                yield message
            if self._fault is not None:
                raise self._fault
        finally:
            self._stop.set()
            player.join()

    def _play(self) -> None:
        start_s, first_ns = monotonic_s(), None
        try:
            for message in self._messages:
                if first_ns is None and isinstance(message, Frame):
                    start_s, first_ns = monotonic_s(), message.t_ns
                if first_ns is not None:
                    due_s = start_s + (message.t_ns - first_ns) * 1e-9 / self._speed
                    wait_s(self._stop, due_s - monotonic_s())
                if self._stop.is_set():
                    return
                self._put(message)
        except BaseException as fault:  # handed to the working thread, which raises it
            self._fault = fault
        finally:
            with self._changed:
                self._done = True
                self._changed.notify()

    def _put(self, message: Message) -> None:
        with self._changed:
            if isinstance(message, Frame):
                old = next((m for m in self._waiting if isinstance(m, Frame)), None)
                if old is not None:
                    self._waiting.remove(old)
                    self.n_dropped += 1
            self._waiting.append(message)
            self._changed.notify()
