"""Pages of libraries that are given back: only a file's own, and they come back."""

from __future__ import annotations

import subprocess
import sys

from drivers.system.file_pages import _unchanged

SMAPS = """\
7f0000000000-7f0000010000 r-xp 00001000 fe:00 11      /usr/lib/libcode.so.1.2
Rss:                  40 kB
Anonymous:             0 kB
Swap:                  0 kB
VmFlags: rd ex mr mw me
7f0000010000-7f0000020000 r--p 00011000 fe:00 11      /usr/lib/libcode.so.1.2
Rss:                  40 kB
Anonymous:             4 kB
Swap:                  0 kB
7f0000020000-7f0000030000 r--p 00021000 fe:00 11      /usr/lib/libcode.so.1.2
Rss:                  40 kB
Anonymous:             0 kB
Swap:                  4 kB
7f0000030000-7f0000040000 rw-p 00031000 fe:00 11      /usr/lib/libcode.so.1.2
Rss:                  40 kB
Anonymous:             0 kB
Swap:                  0 kB
7f0000040000-7f0000050000 r--s 00000000 00:05 12      /usr/lib/libshared.so
Rss:                  40 kB
Anonymous:             0 kB
Swap:                  0 kB
7f0000050000-7f0000060000 r--p 00000000 fe:00 13      /usr/lib/libgone.so (deleted)
Rss:                  40 kB
Anonymous:             0 kB
Swap:                  0 kB
7f0000060000-7f0000070000 r--p 00000000 fe:00 14      /srv/flight.mcap
Rss:                  40 kB
Anonymous:             0 kB
Swap:                  0 kB
7f0000070000-7f0000080000 r-xp 00000000 00:00 0
Rss:                  40 kB
Anonymous:             0 kB
Swap:                  0 kB
7f0000080000-7f0000090000 r--p 00000000 fe:00 15      /opt/lib/code.cpython-311-aarch64-linux-gnu.so
Rss:                   8 kB
Anonymous:             0 kB
Swap:                  0 kB
"""
PROGRAM = """
import re, sys
import cv2, numpy as np
from pathlib import Path
from drivers.system.file_pages import give_back_library_pages

def file_kib():
    text = Path("/proc/self/smaps_rollup").read_text()
    of = lambda name: int(re.search(name + r": +(\\d+) kB", text)[1])
    return of("Rss") - of("Anonymous")

def blurred():
    return cv2.GaussianBlur(np.arange(4096.0).reshape(64, 64), (5, 5), 1.0)

expected, before = blurred(), file_kib()
given_back = give_back_library_pages() >> 10
after = file_kib()
assert np.array_equal(blurred(), expected)
print(before, given_back, after)
"""


def test_only_what_differs_nowhere_from_the_file_is_given_back() -> None:
    assert list(_unchanged(SMAPS)) == [
        (0x7F0000000000, 0x7F0000010000, 40 << 10),
        (0x7F0000080000, 0x7F0000090000, 8 << 10),
    ]


def test_pages_are_given_back_and_come_back() -> None:
    told = subprocess.run(
        [sys.executable, "-c", PROGRAM], check=True, capture_output=True, text=True
    ).stdout
    before, given_back, after = map(int, told.split())
    assert given_back > 8_000, "most of numpy and OpenCV"
    assert after < before - given_back // 2
