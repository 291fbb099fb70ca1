"""Writer thread of a recording, which may block on the disk.

Messages wait in memory, up to a limit; beyond it new ones are dropped, images first. Twice a second
or so all of them are written as a chunk and synced.
"""

from __future__ import annotations

import contextlib
import errno
import os
import tempfile
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from pathlib import Path
from typing import IO, NamedTuple

from companion.config import RecorderConfig
from companion.errors import FlightError
from companion.messages import Warned
from drivers.recording.flights_folder import delete, flights_in, free_bytes, may_go
from drivers.recording.growing_file import GrowingFile
from drivers.recording.mcap_writer import McapWriter

CHUNK_BYTES = 4 << 20
"""Size at which a chunk is written early."""
PICTURES_SHARE = 0.8
"""Share of the buffer for images, so that small messages always fit."""
LOOK_S = 2.0
"""Interval of checks of the free space."""
RESERVE_BYTES = 1 << 20
"""Space reserved for the end of the file: a disk may fill up between two checks."""
NO_ROOM = (errno.ENOSPC, errno.EDQUOT)

FULL, PRUNED = "the disk is full: the flight is no longer recorded", "an old flight was deleted"
SLOW = "the disk is too slow: parts of the flight are not recorded"
FAILED = "the recording cannot be written"


class Entry(NamedTuple):
    """One message to be written."""

    channel: int
    t_ns: int
    data: bytes
    sequence: int | None = None


class DiskWriter:
    """Writes messages and packets of one flight; `warn` is called in its thread."""

    def __init__(
        self, config: RecorderConfig, mcap: GrowingFile, writer: McapWriter, tlog: GrowingFile,
        flight: Path, now_ns: Callable[[], int], warn: Callable[[Warned], None],
    ) -> None:  # fmt: skip
        self._config, self._mcap, self._writer, self._tlog = config, mcap, writer, tlog
        self._flight, self._now_ns, self._warn = flight, now_ns, warn
        self._most = config.buffer_mb << 20
        self._entries: deque[Entry] = deque()
        self._packets: list[bytes] = []
        self._n_waiting = 0
        self._changed = threading.Condition()
        self._closing = False
        self._ended = False
        self._fault: BaseException | None = None
        self._looked_s = -LOOK_S
        self._warned_kinds: set[str] = set()
        self.n_dropped: Counter[str] = Counter()
        """Dropped messages, by kind."""
        self.slowest_s = 0.0
        """Longest time to write a chunk."""
        self._reserve = _reserved(flight)
        self._thread = threading.Thread(target=self._run, name="disk", daemon=True)
        self._thread.start()

    @property
    def recording(self) -> bool:
        """True while new messages are still written."""
        return not self._ended

    def put(self, entry: Entry, kind: str, is_picture: bool = False) -> bool:
        """Queue a message; never waits. False where there is no capacity for it.

        Raises the exception of the thread, if it had a bug.
        """
        if self._fault is not None:
            raise self._fault
        with self._changed:
            capacity = self._most * (PICTURES_SHARE if is_picture else 1.0)
            if self._ended or self._n_waiting + len(entry.data) > capacity:
                self.n_dropped[kind] += 1
                too_slow = not self._ended
            else:
                self._entries.append(entry)
                self._n_waiting += len(entry.data)
                if self._has_enough():  # to wake the thread for each costs more than to queue it
                    self._changed.notify()
                return True
        if too_slow:
            self._tell_once(SLOW, f"{self._most >> 20} MB wait for it")
        return False

    def put_packet(self, packet: bytes) -> None:
        """Queue a packet for the .tlog; never waits."""
        with self._changed:
            if not self._ended and self._n_waiting + len(packet) <= self._most:
                self._packets.append(packet)
                self._n_waiting += len(packet)

    def close(self) -> None:
        """Write the rest, and the index; waits for it. Raises as `put` does."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()
        if self._fault is not None:
            raise self._fault

    def _run(self) -> None:
        try:
            self._work()
        except BaseException as fault:  # handed to the thread that records, which raises it
            self._fault = fault
        finally:
            self._reserve.close()
            self._mcap.close()
            self._tlog.close()

    def _work(self) -> None:
        due_s = time.monotonic()
        while not self._ended:
            with self._changed:
                self._changed.wait_for(self._has_enough, max(0.0, due_s - time.monotonic()))
                entries, self._entries = self._entries, deque()
                packets, self._packets = self._packets, []
                closing = self._closing
            began_s = time.monotonic()
            self._make_room()
            for entry in entries:
                self._writer.add(entry.channel, entry.t_ns, entry.data, entry.t_ns, entry.sequence)
                if self._writer.n_waiting_bytes > CHUNK_BYTES:
                    self._do(self._writer.flush)
            self._do(self._writer.flush)
            self._do(lambda: self._tlog.append(b"".join(packets)))  # noqa: B023 - done at once
            self._do(self._mcap.sync)
            self._do(self._tlog.sync)
            if self._ended:
                self.n_dropped["messages"] += self._writer.drop_waiting()
            self.slowest_s = max(self.slowest_s, time.monotonic() - began_s)
            with self._changed:
                self._n_waiting -= sum(len(entry.data) for entry in entries)
                self._n_waiting -= sum(map(len, packets))
            due_s = began_s + self._config.flush_s
            if closing and not self._ended:
                self._end()

    def _has_enough(self) -> bool:
        return self._closing or self._n_waiting > CHUNK_BYTES

    def _do(self, step: Callable[[], None]) -> None:
        """Call; on a full disk make space and try again, or end."""
        while not self._ended:
            try:
                step()
                return
            except OSError as error:
                if error.errno not in NO_ROOM:
                    self._end(FAILED, f"{self._flight}: {error.strerror}")
                elif not self._delete_oldest():
                    self._end(FULL, str(self._flight))

    def _make_room(self) -> None:
        """Check the free space, and apply `when_full` where it is short."""
        now_s = time.monotonic()
        if now_s - self._looked_s < LOOK_S:
            return
        self._looked_s = now_s
        least = self._config.least_free_mb << 20
        try:
            while free_bytes(self._flight) < least:
                if not self._delete_oldest():
                    self._end(FULL, str(self._flight))
                    return
        except OSError as error:
            self._end(FAILED, str(error))

    def _delete_oldest(self) -> bool:
        """Delete the oldest flight; whether space was made."""
        if self._config.when_full != "prune":
            return False
        try:
            flights = flights_in(self._flight.parent)
        except (OSError, FlightError):  # a folder that cannot be read has none that may go
            return False
        for flight in may_go(flights, but=self._flight):
            try:
                delete(flight)
            except OSError:
                continue
            detail = f"{flight.path.name}, {flight.n_bytes >> 20} MB"
            self._warn(Warned(self._now_ns(), PRUNED, detail))
            return True
        return False

    def _end(self, what: str = "", detail: str = "") -> None:
        """End writing; completes the file in the reserved space."""
        with self._changed:
            self._ended = True
            self.n_dropped["messages"] += len(self._entries)
            self._entries.clear()
        if what:
            self.n_dropped["messages"] += self._writer.drop_waiting()
            self._tell_once(what, detail)
        self._reserve.close()
        try:
            self._writer.finish()
            self._mcap.sync()
        except OSError:
            pass  # it will be repaired when it is opened

    def _tell_once(self, what: str, detail: str) -> None:
        if what not in self._warned_kinds:
            self._warned_kinds.add(what)
            self._warn(Warned(self._now_ns(), what, detail))


def _reserved(folder: Path) -> IO[bytes]:
    """Unlinked file that reserves space; closing it frees the space."""
    reserve = tempfile.TemporaryFile(dir=folder)
    with contextlib.suppress(OSError):  # the disk is full now: the first look says so
        os.posix_fallocate(reserve.fileno(), 0, RESERVE_BYTES)
    return reserve
