"""Priority of a process: the lowest for processor and disk, for a while, and back from it."""

from __future__ import annotations

import contextlib
import os
from concurrent.futures import ThreadPoolExecutor

import psutil


def give_way(pid: int) -> None:
    """Give a process the lowest priority for processor and disk."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(pid, os.SCHED_IDLE, os.sched_param(0))
    with contextlib.suppress(OSError, psutil.Error):
        psutil.Process(pid).ionice(psutil.IOPRIO_CLASS_IDLE)


def take_turn(pid: int, levels: int) -> None:
    """Take a process by so many nice levels before this one, where the kernel allows it."""
    with contextlib.suppress(PermissionError, ProcessLookupError):
        os.setpriority(os.PRIO_PROCESS, pid, os.getpriority(os.PRIO_PROCESS, 0) - levels)


def processor_time_s(pid: int) -> float:
    """Processor time that a process has had; 0 where it has ended."""
    with contextlib.suppress(psutil.Error):
        times = psutil.Process(pid).cpu_times()
        return float(times.user + times.system)
    return 0.0


def may_take_back() -> bool:
    """True where this process may leave the idle class again; tried by a thread of its own.

    The kernel asks for RLIMIT_NICE down to its nice level, or for CAP_SYS_NICE.
    """

    def tried() -> bool:
        try:
            for policy in (os.SCHED_IDLE, os.SCHED_OTHER):
                os.sched_setscheduler(0, policy, os.sched_param(0))
        except OSError:
            return False
        return True

    with ThreadPoolExecutor(1) as thread:
        return thread.submit(tried).result()


def all_threads_idle(idle: bool) -> None:
    """Put all threads of this process into the idle class, or into the usual one."""
    policy = os.SCHED_IDLE if idle else os.SCHED_OTHER
    changed = True
    while changed:  # one that was not changed yet may have started another meanwhile
        changed = False
        for thread in map(int, os.listdir("/proc/self/task")):
            with contextlib.suppress(ProcessLookupError):  # it has ended
                if os.sched_getscheduler(thread) != policy:
                    os.sched_setscheduler(thread, policy, os.sched_param(0))
                    changed = True
