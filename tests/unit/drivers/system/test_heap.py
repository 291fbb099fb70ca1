"""The heap's bounds: what is freed returns to the system, in this process and in its children."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

PROGRAM = """
import os, re, sys, threading
from pathlib import Path
import numpy as np
from drivers.system.heap import BOUNDS, bound_heap, give_back_heap

def resident_mib():
    text = Path("/proc/self/smaps_rollup").read_text()
    return int(re.search(r"Rss: +(\\d+) kB", text)[1]) / 1024

def fill():
    del [np.ones(30 << 20, np.uint8)][:]  # after which glibc has as large arrays in the heap
    both = [(np.ones(4 << 20, np.uint8), np.ones(200_000, np.uint8)) for _ in range(10)]
    kept.extend(small for large, small in both)  # between the large ones

if sys.argv[1] == "bound":
    bound_heap()
before = resident_mib()
kept = []
thread = threading.Thread(target=fill)
thread.start()
thread.join()
print(resident_mib() - before)
give_back_heap()
print(resident_mib() - before)
print(*(os.environ.get(name) for name in BOUNDS))
"""

pytestmark = pytest.mark.skipif(
    "CS_GNU_LIBC_VERSION" not in os.confstr_names, reason="the heap is not glibc's"
)


def told(how: str, **environment: str) -> list[str]:
    inherited = {k: v for k, v in os.environ.items() if not k.startswith("MALLOC_")}
    return subprocess.run(
        [sys.executable, "-c", PROGRAM, how], check=True, capture_output=True, text=True,
        env={**inherited, **environment},
    ).stdout.splitlines()  # fmt: skip


def test_large_arrays_that_are_freed_are_not_kept() -> None:
    unbound_mib, bound_mib = float(told("unbound")[0]), float(told("bound")[0])
    assert unbound_mib > 30
    assert bound_mib < 5


def test_what_is_kept_can_be_given_back() -> None:
    kept_mib, left_mib, _ = told("unbound")
    assert float(left_mib) < float(kept_mib) - 30


def test_processes_that_are_started_inherit_the_bounds() -> None:
    assert told("bound")[2] == "2 1048576 2097152"
    assert told("unbound")[2] == "None None None"


def test_what_the_environment_sets_stays() -> None:
    assert told("bound", MALLOC_ARENA_MAX="7")[2] == "7 1048576 2097152"
