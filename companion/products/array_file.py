"""A temporary file of arrays, mapped into memory: read as they are used, and forgotten again."""

from __future__ import annotations

import mmap
import os
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from weakref import finalize

import numpy as np

SEGMENT_BYTES = 64 << 20
"""Mapped at once: each mapping holds a descriptor."""
ALIGNMENT = 64
"""Of arrays, for vector instructions."""
FORGOTTEN_AFTER = 64
"""Calls of `put`, after which what was read is forgotten: what is used often comes back at once, as
the system keeps it while it has memory to spare."""


class ArrayFile:
    """Arrays that are seldom read, in an unlinked file in `folder`.

    The system removes it however the program ends. Once the disk takes no more nothing is put there
    again: `fault` says why.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._descriptor = -1
        self._segments: list[mmap.mmap] = []
        self._begin = self._at = self._end = 0
        """Begin of the newest segment in the file, the next array in it, and its length."""
        self._n_put = 0
        self._lock = threading.Lock()
        """Tracking and mapping put arrays there, each in a thread of its own."""
        self.n_bytes = 0
        self.fault = ""

    def put(self, arrays: Sequence[Any]) -> list[Any] | None:
        """Equal arrays, read-only, that lie in the file; None where the disk takes no more."""
        if self.fault:
            return None
        with self._lock:
            try:
                kept = self._put([np.ascontiguousarray(each) for each in arrays])
            except OSError as error:
                self.fault = f"{self._folder}: {error.strerror or error}"
                return None
            self._n_put += 1
            if self._n_put % FORGOTTEN_AFTER == 0:
                self.forget()
        return kept

    def forget(self) -> None:
        """Give back the memory of what was read; it is read again where it is used again."""
        for segment in self._segments:
            segment.madvise(mmap.MADV_DONTNEED)

    def _put(self, arrays: list[Any]) -> list[Any]:
        padded = [each.nbytes + -each.nbytes % ALIGNMENT for each in arrays]
        if self._at + sum(padded) > self._end:
            self._begin_segment(max(SEGMENT_BYTES, sum(padded)))
        segment, kept = self._segments[-1], []
        for each, n_bytes in zip(arrays, padded, strict=True):
            self._write(memoryview(each.reshape(-1).view(np.uint8)))
            kept.append(np.ndarray(each.shape, each.dtype, segment, self._at))
            self._at += n_bytes
            self.n_bytes += n_bytes
        return kept

    def _begin_segment(self, n_bytes: int) -> None:
        if self._descriptor < 0:
            with tempfile.TemporaryFile(dir=self._folder) as file:
                self._descriptor = os.dup(file.fileno())
            finalize(self, os.close, self._descriptor)
        begin = self._begin + self._end
        n_bytes += -n_bytes % mmap.ALLOCATIONGRANULARITY
        os.ftruncate(self._descriptor, begin + n_bytes)  # takes no room on the disk
        self._segments.append(
            mmap.mmap(self._descriptor, n_bytes, mmap.MAP_SHARED, mmap.PROT_READ, offset=begin)
        )
        self._begin, self._at, self._end = begin, 0, n_bytes

    def _write(self, left: memoryview) -> None:
        """Write an array; not through the mapping, which ends the process where a disk is full."""
        at = self._begin + self._at
        while left:
            n = os.pwrite(self._descriptor, left, at)
            left, at = left[n:], at + n
