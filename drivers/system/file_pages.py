"""Pages of libraries: what only loading needed is given back."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Iterator
from pathlib import Path

SMAPS = Path("/proc/self/smaps")
MADV_DONTNEED = 4
_UNCHANGED = re.compile(
    r"^([0-9a-f]+)-([0-9a-f]+) r-[-x]p \S+ \S+ \d+ +/.*\.so(?:\.[0-9.]+)?\n"
    r"(?:[A-Z].*\n)*?Rss: +([1-9]\d*) kB\n"
    r"(?:[A-Z].*\n)*?Anonymous: +0 kB\n"
    r"(?:[A-Z].*\n)*?Swap: +0 kB$",
    re.MULTILINE,
)
"""Mapping of a library that cannot be written to, with pages in memory, all of them the file's."""


def give_back_library_pages() -> int:
    """Unmap the unchanged pages of the libraries' files; the bytes, which others may still use.

    Loading a large library touches far more of it than is used later: a compiler of kernels or
    loops, once these are compiled. The system can take such pages at any time, but sees them as in
    use; now they are cache. What is needed again comes back by itself, page by page.

    Call it where no other thread loads or unloads libraries.
    """
    madvise = ctypes.CDLL(None, use_errno=True).madvise
    madvise.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
    n_bytes = 0
    for begin, end, resident in list(_unchanged(SMAPS.read_text())):
        if madvise(begin, end - begin, MADV_DONTNEED) == 0:
            n_bytes += resident
    return n_bytes


def _unchanged(smaps: str) -> Iterator[tuple[int, int, int]]:
    """Begin, end and resident bytes of mappings of libraries that differ nowhere from the file.

    None of them can be written to; one with pages of its own was, when it was relocated.
    """
    for mapping in _UNCHANGED.finditer(smaps):
        yield int(mapping[1], 16), int(mapping[2], 16), int(mapping[3]) << 10
