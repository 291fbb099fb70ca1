"""Pages of libraries: what only loading needed is given back."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Iterator
from pathlib import Path

SMAPS = Path("/proc/self/smaps")
MADV_DONTNEED = 4
_MAPPING = re.compile(r"([0-9a-f]+)-([0-9a-f]+) (\S{4}) \S+ \S+ \d+ *(.*)")
_SIZE = re.compile(r"(\w+): +(\d+) kB")
_LIBRARY = re.compile(r"/.*\.so(\.[0-9.]+)?")
_READ_ONLY = ("r--p", "r-xp")
_OWN = ("Anonymous", "Swap")
"""Pages that are no longer the file's."""


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
    mapping: re.Match[str] | None = None
    kib: dict[str, int] = {}
    for line in [*smaps.splitlines(), "0-0 ---p 0 0 0 end"]:
        size = _SIZE.match(line)
        if size is not None:
            kib[size[1]] = int(size[2])
        elif (next_mapping := _MAPPING.match(line)) is not None:
            if mapping is not None and kib.get("Rss") and not any(kib[own] for own in _OWN):
                yield int(mapping[1], 16), int(mapping[2], 16), kib["Rss"] << 10
            unwritten = next_mapping[3] in _READ_ONLY and _LIBRARY.fullmatch(next_mapping[4])
            mapping, kib = next_mapping if unwritten else None, {}
