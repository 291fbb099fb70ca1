"""Lowest priority of a process for processor and disk."""

from __future__ import annotations

import contextlib
import os

import psutil


def give_way(pid: int) -> None:
    """Give a process the lowest priority for processor and disk."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(pid, os.SCHED_IDLE, os.sched_param(0))
    with contextlib.suppress(OSError, psutil.Error):
        psutil.Process(pid).ionice(psutil.IOPRIO_CLASS_IDLE)
