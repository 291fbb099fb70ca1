"""Frames in memory that the processes of the stages share: written once, read by whoever needs it.

The memory has no name and goes with the last process that has it, however that one ends. A reader
that comes too late finds its frame overwritten, and is told so.
"""

from __future__ import annotations

import mmap
import os
from dataclasses import dataclass

import numpy as np

from companion.messages import Bytes, Frame

ROOM_BYTES = 64 << 20
LEAST_SLOTS, MOST_SLOTS = 8, 48
NO_COLOUR = np.zeros((0, 0, 3), np.uint8)


@dataclass(frozen=True, slots=True)
class FrameInRing:
    """Where a frame lies; `serial` says whether it still does."""

    seq: int
    t_ns: int
    serial: int


class FrameRing:
    """Slots for frames of one size; the oldest is overwritten. One writer, many readers."""

    def __init__(self, width: int, height: int, fd: int | None = None) -> None:
        self._pixels = width * height
        self._shape = (height, width)
        frame_bytes = 4 * self._pixels
        self.n_slots = int(np.clip(ROOM_BYTES // frame_bytes, LEAST_SLOTS, MOST_SLOTS))
        size = self.n_slots * (frame_bytes + 8)
        self.fd = os.memfd_create("companion-frames") if fd is None else fd
        if fd is None:
            os.ftruncate(self.fd, size)
        self._memory = mmap.mmap(self.fd, size)
        whole = np.frombuffer(self._memory, np.uint8)
        self._serials = whole[: 8 * self.n_slots].view(np.int64)
        self._slots = whole[8 * self.n_slots :].reshape(self.n_slots, frame_bytes)
        self._next = 1

    def put(self, frame: Frame) -> FrameInRing:
        """Copy a frame in; it must be of the ring's size."""
        serial, self._next = self._next, self._next + 1
        at = serial % self.n_slots
        slot = self._slots[at]
        self._serials[at] = 0
        slot[: self._pixels].reshape(self._shape)[:] = frame.grey
        slot[self._pixels :].reshape(*self._shape, 3)[:] = frame.rgb
        self._serials[at] = serial
        return FrameInRing(frame.seq, frame.t_ns, serial)

    def get(self, place: FrameInRing, colour: bool = True) -> Frame | None:
        """A copy of a frame, without its colours if not wanted; None if it was overwritten."""
        at = place.serial % self.n_slots
        if self._serials[at] != place.serial:
            return None
        slot = self._slots[at]
        grey: Bytes = slot[: self._pixels].reshape(self._shape).copy()
        rgb = slot[self._pixels :].reshape(*self._shape, 3).copy() if colour else NO_COLOUR
        if self._serials[at] != place.serial:
            return None
        return Frame(place.seq, place.t_ns, grey, rgb)

    def close(self) -> None:
        """Let go of the memory."""
        del self._serials, self._slots
        self._memory.close()
        os.close(self.fd)
