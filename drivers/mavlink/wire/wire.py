"""Base of all wires: opened, watched by the event loop, reopened when lost."""

from __future__ import annotations

import asyncio
import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine
from typing import Any, Protocol

from companion.errors import SourceError
from companion.timing.rate_limit import RateLimit
from drivers.mavlink.wire.send_queue import PacketQueue

FIRST_RETRY_S, MOST_RETRY_S = 0.1, 0.5
STALLED_NS = 30_000_000_000
LOOK_S = 0.1


async def run_together(*parts: Coroutine[Any, Any, None]) -> None:
    """Run all until one fails or this is cancelled; none is left running.

    Each is cancelled once only: again, as a cancelled `gather` does, would break off its ending.
    """
    tasks = [asyncio.ensure_future(part) for part in parts]
    try:
        if tasks:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_EXCEPTION)
    finally:
        for task in tasks:
            task.cancel()
        ended = await asyncio.gather(*tasks, return_exceptions=True)
    for failure in ended:
        if isinstance(failure, Exception):
            raise failure


Tap = Callable[[bool, bytes, int], None]
"""Takes whether bytes were sent, the bytes, and their time by CLOCK_MONOTONIC; must not block."""


class WireEnd(Protocol):
    """Our end of a wire."""

    def opened(self) -> None:
        """The wire is open, for the first time or again; earlier bytes do not belong to it."""

    def received(self, data: bytes, monotonic_ns: int) -> int:
        """Take received bytes; returns the number of packets of known messages in them."""


class Wire(ABC):
    """Non-blocking byte transport.

    Packets are written whole and in order; while the wire is not ready they wait in `queue`, and
    while it is not open they are dropped. `read_limit` holds back a peer that sends too much.
    """

    is_line = False
    """True of a serial line, whose `bytes_per_s` is its baud rate's."""
    read_size = 65536
    reads_at_once = 1

    def __init__(
        self, name: str, bytes_per_s: float, queue: PacketQueue, read_limit: RateLimit | None = None
    ) -> None:
        self.name = name
        self.bytes_per_s = bytes_per_s
        """Capacity, as far as known."""
        self.queue = queue
        self.connected = False
        self.trouble = ""
        """Reason why it is not connected, or problem of its input; "" without one."""
        self.n_unsent = 0
        """Packets dropped while the wire was not open."""
        self.tap: Tap | None = None
        """Called with all bytes written, and those read that are the other side's."""
        self._read_limit = read_limit
        self._fd = -1
        self._lost: asyncio.Future[str] | None = None
        self._paused: asyncio.TimerHandle | None = None
        self._delayed: asyncio.TimerHandle | None = None
        self._looking: asyncio.TimerHandle | None = None
        self._waiting = False
        self._progress_ns = 0

    @property
    def n_dropped(self) -> int:
        """Packets that were not sent."""
        return self.n_unsent + self.queue.n_dropped

    async def run(self, end: WireEnd) -> None:
        """Keep the wire open until cancelled."""
        retry_s = FIRST_RETRY_S
        while True:
            try:
                fd = await self._open()
            except SourceError as error:
                self.trouble = str(error)
                await asyncio.sleep(retry_s)
                retry_s = min(2 * retry_s, MOST_RETRY_S)
                continue
            retry_s = FIRST_RETRY_S
            await self.serve(fd, end)
            await asyncio.sleep(retry_s)

    async def serve(self, fd: int, end: WireEnd) -> None:
        """Use an open `fd` until it is lost or this is cancelled; then close it."""
        loop = asyncio.get_running_loop()
        self._fd = fd
        self._lost = loop.create_future()
        self._progress_ns = time.monotonic_ns()
        self.connected, self.trouble = True, ""
        try:
            end.opened()
            loop.add_reader(fd, self._readable, end)
            self.trouble = await self._lost
        finally:
            self.connected = False
            loop.remove_reader(fd)
            loop.remove_writer(fd)
            for timer in (self._paused, self._delayed, self._looking):
                if timer is not None:
                    timer.cancel()
            self._paused = self._delayed = None
            self._waiting = False
            self.queue.clear()
            self._fd = -1
            self._close()

    def write(self, packet: bytes) -> None:
        """Send a whole packet as soon as possible; never waits, never raises."""
        if not self.connected:
            self.n_unsent += 1
            return
        self.queue.push(packet)
        if not self._waiting:
            self._flush()
        elif time.monotonic_ns() - self._progress_ns > STALLED_NS:
            self.lose("nothing was taken for 30 s")

    def lose(self, why: str) -> None:
        """Close the wire as lost; `run` opens it again."""
        if self._lost is not None and not self._lost.done():
            self._lost.set_result(f"{self.name}: {why}")
        self.connected = False

    @abstractmethod
    async def _open(self) -> int:
        """Open it; SourceError where impossible now."""

    @abstractmethod
    def _close(self) -> None:
        """Close the present file descriptor."""

    @abstractmethod
    def _read(self) -> tuple[bytes, int]:
        """Some bytes and their arrival by CLOCK_MONOTONIC; OSError, EOFError."""

    def _deliver(self, end: WireEnd, data: bytes, monotonic_ns: int) -> None:
        self._accept(end, data, monotonic_ns)

    def _accept(self, end: WireEnd, data: bytes, monotonic_ns: int) -> int:
        """Give bytes of the other side to the tap and to `end`; packets as of `received`."""
        if self.tap is not None:
            self.tap(False, data, monotonic_ns)
        return end.received(data, monotonic_ns)

    def _write(self, data: bytes) -> int:
        return os.write(self._fd, data)

    def _look_later(self, look: Callable[..., None], *arguments: object) -> None:
        """Call soon, unless the wire is closed before."""
        self._looking = asyncio.get_running_loop().call_later(LOOK_S, look, *arguments)

    def _room(self) -> float:
        """Seconds to wait before more may be written; 0 for now."""
        return 0.0

    def _readable(self, end: WireEnd) -> None:
        for _ in range(self.reads_at_once):
            try:
                data, monotonic_ns = self._read()
            except (BlockingIOError, InterruptedError):
                return
            except EOFError:
                self.lose("closed by the other side")
                return
            except OSError as error:
                self.lose(error.strerror or str(error))
                return
            must_pause = self._has_too_much(data, monotonic_ns, end)
            self._deliver(end, data, monotonic_ns)
            if must_pause or not self.connected:
                return

    def _has_too_much(self, data: bytes, monotonic_ns: int, end: WireEnd) -> bool:
        limit = self._read_limit
        if limit is None:
            return False
        limit.refill(monotonic_ns)
        limit.take(max(64, len(data)))  # many small pieces are work too
        if limit.left >= 0:
            return False
        loop = asyncio.get_running_loop()
        loop.remove_reader(self._fd)
        self._paused = loop.call_later(limit.wait_s(limit.burst / 2), self._resume, end)
        return True

    def _resume(self, end: WireEnd) -> None:
        self._paused = None
        if self.connected:
            asyncio.get_running_loop().add_reader(self._fd, self._readable, end)

    def _flush(self) -> None:
        if not self._waiting:
            self._progress_ns = time.monotonic_ns()
        try:
            while self.queue:
                wait_s = self._room()
                if wait_s > 0:
                    self._wait(wait_s)
                    return
                head = self.queue.head()
                n_bytes = self._write(head)
                self.queue.written(n_bytes)
                self._progress_ns = time.monotonic_ns()
                if self.tap is not None:
                    self.tap(True, head[:n_bytes], self._progress_ns)
        except (BlockingIOError, InterruptedError):
            self._waiting = True
            asyncio.get_running_loop().add_writer(self._fd, self._writable)
            return
        except OSError as error:
            self.lose(error.strerror or str(error))
            return
        self._waiting = False

    def _wait(self, wait_s: float) -> None:
        self._waiting = True
        self._delayed = asyncio.get_running_loop().call_later(wait_s, self._flush_later)

    def _flush_later(self) -> None:
        self._delayed = None
        if self.connected:
            self._flush()

    def _writable(self) -> None:
        asyncio.get_running_loop().remove_writer(self._fd)
        if self.connected:
            self._flush()
