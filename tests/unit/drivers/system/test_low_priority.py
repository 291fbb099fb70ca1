"""Threads of a process leave the idle class again where the kernel allows it, and only there."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

PROGRAM = """
import os, sys, threading
from drivers.system.low_priority import all_threads_idle, may_take_back

os.nice(15)
os.setuid(int(sys.argv[1]))
other = threading.Thread(target=threading.Event().wait, daemon=True)
other.start()

def policies():
    return [os.sched_getscheduler(each) for each in (os.getpid(), other.native_id)]

print(may_take_back(), policies())
all_threads_idle(True)
print(policies())
if may_take_back():
    all_threads_idle(False)
    print(policies(), os.getpriority(os.PRIO_PROCESS, 0))
"""


@pytest.mark.skipif(os.getuid() != 0, reason="gives up the rights that others lack")
@pytest.mark.parametrize(
    ("user", "wanted"),
    [(0, "True [0, 0]\n[5, 5]\n[0, 0] 15\n"), (65534, "False [0, 0]\n[5, 5]\n")],
)
def test_threads_give_way_and_come_back(user: int, wanted: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(user)], capture_output=True, text=True, check=True
    )
    assert done.stdout == wanted
