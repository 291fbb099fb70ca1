"""Queue of messages to the process of a stage, and how they are sent: at once, or gathered."""

from __future__ import annotations

import socket
import threading
from functools import cache

from companion.runtime.mailbox import Mailbox
from companion.runtime.parcel import INLINE_BYTES, Parcel
from companion.runtime.stages import QUEUE_BYTES, UNREAD_BYTES, Frames, Stage, drop_policy

GATHER_S = 0.05
"""Small messages gather for this long, or until a frame."""


class StageOutbox:
    """Messages that wait for a stage, and go through its socket.

    `send_all` is for a thread that does nothing else. Where a queue is full messages are dropped;
    with `waits` whoever has another waits.
    """

    def __init__(self, stage: Stage, to: socket.socket, waits: bool) -> None:
        policy = cache(lambda kind: drop_policy(stage, kind, in_daemon=True))
        self._waiting: Mailbox[Parcel] = Mailbox(
            lambda parcel: policy(parcel.kind), lambda parcel: parcel.n_bytes, QUEUE_BYTES, waits
        )
        self._socket = to
        self._is_prompt = stage.frames is Frames.NEWEST
        self._puts = threading.Lock()
        """Keeps what is sent at once in order with what waits."""
        self._n_sent = self._n_taken = 0
        """Bytes of shared memory, so far."""
        self._was_taken = threading.Condition()
        self._is_open = True

    @property
    def n_dropped(self) -> int:
        """Messages dropped, frames most of all."""
        return self._waiting.n_dropped + self._waiting.n_overflowed

    @property
    def n_bytes(self) -> int:
        """Bytes of messages that wait."""
        return self._waiting.n_bytes

    def put(self, parcel: Parcel) -> None:
        """Send a message now where nothing waits and the socket takes it, else let it wait.

        Handing it over to the thread that sends costs more than sending it.
        """
        if not self._is_prompt:
            self._waiting.put(parcel)
            return
        with self._puts:
            if not (self._waiting.is_idle and self._is_sent(parcel)):
                self._waiting.put(parcel)

    def close(self) -> None:
        """Take no more; what waits is sent."""
        self._waiting.close()

    def hear_taken(self, n_bytes: int) -> None:
        """Hear how many bytes of shared memory the process has taken so far."""
        with self._was_taken:
            self._n_taken = n_bytes
            self._was_taken.notify()

    def hear_gone(self) -> None:
        """Hear that nobody takes anything any more."""
        self._waiting.close()
        with self._was_taken:
            self._is_open = False
            self._was_taken.notify()

    def send_all(self) -> str:
        """Send what comes, until it is closed or the process gone; why that could not be, or ""."""
        try:
            pause_s = 0.0 if self._is_prompt else GATHER_S
            while parcels := self._waiting.collect(INLINE_BYTES, pause_s):
                if parcels[0].is_shared and not self._has_room(parcels[0].n_bytes):
                    break
                Parcel.send_together(parcels, self._socket)
        except ConnectionError:
            pass  # it is gone, which is seen where it is read from
        except OSError as error:  # no memory in the kernel, or too many descriptors on their way
            return f"nothing can be sent to it: {error.strerror}"
        return ""

    def _is_sent(self, parcel: Parcel) -> bool:
        """Send a message without waiting; whether it could be."""
        if parcel.is_shared and self._n_sent - self._n_taken > UNREAD_BYTES:
            return False
        try:
            parcel.send(self._socket, socket.MSG_DONTWAIT)
        except OSError:  # full, or gone, of which the thread that sends will learn
            return False
        if parcel.is_shared:
            self._n_sent += parcel.n_bytes  # the thread that counts them else waits for a message
        return True

    def _has_room(self, n_bytes: int) -> bool:
        """Wait until little is on its way; False where the process is gone."""
        with self._was_taken:
            self._was_taken.wait_for(
                lambda: not self._is_open or self._n_sent - self._n_taken <= UNREAD_BYTES
            )
            self._n_sent += n_bytes
            return self._is_open
