"""A process of which nobody notices that it runs."""

from __future__ import annotations

import contextlib
import os

import psutil


def give_way(pid: int) -> None:
    """From now on it gets what no other process wants of processors and disk."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(pid, os.SCHED_IDLE, os.sched_param(0))
    with contextlib.suppress(OSError, psutil.Error):
        psutil.Process(pid).ionice(psutil.IOPRIO_CLASS_IDLE)
