"""Replay in real time, with the frame drops of a live flight.

A frame that comes while the last is being processed replaces any other that waits: the newest wins,
the rest are counted. Telemetry is never dropped.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator

from companion.messages import Frame, Message
from companion.runtime.mailbox import DropPolicy, Mailbox
from companion.runtime.message_size import size_bytes
from companion.timing.clock import monotonic_s, wait_s

CAPACITY_BYTES = 256 << 20
"""Waiting telemetry: more than an hour's."""


class PacedFeed:
    """Plays messages at the times of their stamps; iterate over it in the working thread."""

    def __init__(self, messages: Iterable[Message], speed: float = 1.0) -> None:
        self._messages = messages
        self._speed = speed
        self._waiting: Mailbox[Message] = Mailbox(
            lambda m: DropPolicy.LATEST_WINS if isinstance(m, Frame) else DropPolicy.LOSSLESS,
            size_bytes, CAPACITY_BYTES,
        )  # fmt: skip
        self._stop = threading.Event()
        self._fault: BaseException | None = None

    @property
    def n_dropped(self) -> int:
        """Frames dropped."""
        return self._waiting.n_dropped

    def __iter__(self) -> Iterator[Message]:
        player = threading.Thread(target=self._play, name="paced", daemon=True)
        player.start()
        try:
            while (message := self._waiting.get()) is not None:
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
                self._waiting.put(message)
        except BaseException as fault:  # handed to the working thread, which raises it
            self._fault = fault
        finally:
            self._waiting.close()
