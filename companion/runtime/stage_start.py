"""Start of a stage's process: what is known of one that was started, and one started anew."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from typing import Protocol

CHILD = "companion.runtime.stage_child"
UNKNOWN_STATUS, NOT_STARTED = 256, 257
"""Beyond those of processes: nobody is left who knows it; no process could be made."""


def ignore_signals() -> None:
    """Have only the daemon say when to end.

    Not Ctrl-C, which is for the daemon's own group of processes, nor systemd. No session of its
    own, though: the scheduler would share the processor between sessions first, and priorities
    would not count between stages (sched(7), autogroup).
    """
    os.setpgid(0, 0)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


class Child(Protocol):
    """A process that was started; subprocess.Popen is one."""

    @property
    def pid(self) -> int | None:
        """Process id; None as long as it is not known."""

    def poll(self) -> int | None:
        """Exit status, negative for a signal; None as long as it runs."""

    def wait(self) -> int:
        """Wait until it has ended; its exit status."""

    def kill(self) -> None:
        """End it now; nothing where it has ended."""


Start = Callable[[str, int], Child]
"""Starts the process of a stage by its name, with the descriptor of its socket."""


def start_alone(name: str, descriptor: int) -> Child:
    """Start an interpreter for a stage, which imports everything itself.

    For one beside a program that needs no others, and where there is no fork server any more.
    """
    return subprocess.Popen(
        [sys.executable, "-m", CHILD, name, str(descriptor)],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, pass_fds=(descriptor,),
    )  # fmt: skip
