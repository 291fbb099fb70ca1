"""The C library's heap: bounds on what it keeps for later, and its return to the system.

glibc only; other C libraries are left as they are.
"""

from __future__ import annotations

import ctypes
import os
from typing import NamedTuple


class _Bound(NamedTuple):
    parameter: int
    """Of mallopt(3)."""
    value: int


BOUNDS = {
    "MALLOC_ARENA_MAX": _Bound(-8, 2),
    "MALLOC_MMAP_THRESHOLD_": _Bound(-3, 1 << 20),
    "MALLOC_TRIM_THRESHOLD_": _Bound(-1, 2 << 20),
}
"""By the variables that glibc reads when a process starts. Each thread would else have a heap of
its own, from which little returns; and after the first large array is freed, such arrays, too,
would come from the heap. With a quarter of a megabyte as the second a replay takes a tenth more of
the processor: images would be mapped anew each time."""


def bound_heap() -> None:
    """Bound the heap of this process and of those that it starts; call it before any thread starts.

    What the environment sets stays.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return
    for variable, bound in BOUNDS.items():
        if variable not in os.environ:
            os.environ[variable] = str(bound.value)
            mallopt(bound.parameter, bound.value)


def give_back_heap() -> None:
    """Return to the system what is free in the heap, wherever in it."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
