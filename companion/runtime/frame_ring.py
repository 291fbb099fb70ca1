"""Ring buffer of frames in shared memory: one writer, readers in other processes.

The memory has no name and is freed with the last process that has it, however that one ends. A late
reader finds its frame overwritten, and is told so.

No frame is torn, on any processor: writer and readers of a slot hold the kernel's lock on its bytes
(fcntl(2), F_SETLK), readers shared, the writer exclusive, and neither waits. The writer skips a
slot that is being read; a slot that is being written is too late for a reader. Loads and stores
between lock and unlock are not visible outside, also where memory is weakly ordered (aarch64): the
kernel changes the list of a file's locks under a spinlock, which acquires and releases. A serial
number before and after the copy, as in a sequence lock, would need barriers that Python does not
offer. A lock costs some microseconds, where a check sum (zlib.crc32) of a frame of 640x480 takes 1
to 6 ms in the writer and in each reader. Locks are a process's and end with it; therefore readers
are in other processes than the writer, and each reads in one thread.
"""

from __future__ import annotations

import fcntl
import mmap
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from companion.errors import StageError
from companion.messages import Bytes, Frame

CAPACITY_BYTES = 64 << 20
LEAST_SLOTS, MOST_SLOTS = 8, 48
NO_COLOUR = np.zeros((0, 0, 3), np.uint8)


@dataclass(frozen=True, slots=True)
class FrameHandle:
    """Place of a frame in the ring; `serial` tells whether it is still there."""

    seq: int
    t_ns: int
    serial: int


class FrameRing:
    """Slots for frames of one size; the oldest is overwritten. One writer, many readers.

    There are more slots than readers; each reader holds one at most.
    """

    def __init__(self, width: int, height: int, fd: int | None = None) -> None:
        self._pixels = width * height
        self._shape = (height, width)
        self.frame_bytes = frame_bytes = 4 * self._pixels
        self.n_slots = int(np.clip(CAPACITY_BYTES // frame_bytes, LEAST_SLOTS, MOST_SLOTS))
        self._begin = 8 * self.n_slots
        """Offset of the first slot, behind all serials."""
        size = self.n_slots * (frame_bytes + 8)
        self.fd = os.memfd_create("companion-frames") if fd is None else fd
        if fd is None:
            os.ftruncate(self.fd, size)
        self._memory = mmap.mmap(self.fd, size)
        whole = np.frombuffer(self._memory, np.uint8)
        self._serials = whole[: 8 * self.n_slots].view(np.int64)
        self._slots = whole[8 * self.n_slots :].reshape(self.n_slots, frame_bytes)
        self._next = 1

    def put(self, frame: Frame) -> FrameHandle:
        """Copy a frame in; it must be of the ring's size."""
        for _ in range(self.n_slots):
            serial, self._next = self._next, self._next + 1
            at = serial % self.n_slots
            with self._locked(at, fcntl.LOCK_EX) as is_ours:
                if not is_ours:
                    continue  # somebody reads it, stopped for a while perhaps: the next one
                slot = self._slots[at]
                self._serials[at] = 0  # should the frame be of another size
                slot[: self._pixels].reshape(self._shape)[:] = frame.grey
                slot[self._pixels :].reshape(*self._shape, 3)[:] = frame.rgb
                self._serials[at] = serial
                return FrameHandle(frame.seq, frame.t_ns, serial)
        raise StageError("more readers than the ring of frames has slots")

    def get(self, place: FrameHandle, colour: bool = True) -> Frame | None:
        """Copy of a frame, optionally without colours; None if it was overwritten."""
        at = place.serial % self.n_slots
        with self._locked(at, fcntl.LOCK_SH) as is_whole:
            if not is_whole or self._serials[at] != place.serial:
                return None
            return self._copy(place, colour)

    def _copy(self, place: FrameHandle, colour: bool) -> Frame:
        slot = self._slots[place.serial % self.n_slots]
        grey: Bytes = slot[: self._pixels].reshape(self._shape).copy()
        rgb = slot[self._pixels :].reshape(*self._shape, 3).copy() if colour else NO_COLOUR
        return Frame(place.seq, place.t_ns, grey, rgb)

    @contextmanager
    def _locked(self, at: int, kind: int) -> Iterator[bool]:
        """Hold a slot's lock; False where a conflicting lock is held."""
        begin, length = self._begin + at * self.frame_bytes, self.frame_bytes
        try:
            fcntl.lockf(self.fd, kind | fcntl.LOCK_NB, length, begin)
        except (BlockingIOError, PermissionError):  # EAGAIN or EACCES, fcntl(2)
            yield False
            return
        try:
            yield True
        finally:
            fcntl.lockf(self.fd, fcntl.LOCK_UN, length, begin)

    def close(self) -> None:
        """Free the memory."""
        del self._serials, self._slots
        self._memory.close()
        os.close(self.fd)
