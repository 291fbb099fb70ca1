"""Process that the page starts for heavy work; its arguments are those of the command it becomes.

It is the first to end where memory is short, and ends with the page. A replay gives way to
everything; what somebody waits for with a board in his hands has the page's own low priority, as on
a busy computer it would get no time at all.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import signal
import sys

from drivers.system.low_priority import give_way

PR_SET_PDEATHSIG = 1
REPLAY = "replay"
FIRST_TO_END = "1000"
"""oom_score_adj(5): the greatest."""


def main() -> None:
    """Become the command."""
    parent = os.getppid()
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it has ended before that
        sys.exit(1)
    if sys.argv[1] == REPLAY:
        give_way(0)
    for limit in (resource.RLIMIT_DATA, resource.RLIMIT_NOFILE):  # those of the page are too low
        most = resource.getrlimit(limit)[1]
        resource.setrlimit(limit, (most, most))
    with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w", encoding="ascii") as f:
        f.write(FIRST_TO_END)
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # which the page ignores
    os.execv(sys.executable, [sys.executable, "-m", "companion", *sys.argv[1:]])


if __name__ == "__main__":
    main()
