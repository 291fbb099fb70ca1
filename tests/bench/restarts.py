"""Time line of a daemon killed in flight and started again: steps, and CPU time by process.

    python -m tests.bench.restarts [--rounds 3] [--cores 1]

The vehicle hovers over what the killed one has mapped; camera and autopilot are made up and have
a core of their own. From the start of the new process on, as the service manager would start it.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path

import psutil

from tests.bench.first_pose import print_steps
from tests.support.flights.halting import Halting
from tests.support.processes.flying import Flying

KEPT_S = 2.5
"""So long after the last pose was told everything there is to know is kept."""
EVERY_S = 0.02
STEPS = {
    "settings in force": "the daemon before ended while armed",
    "autopilot heard": "autopilot found",
    "the flight begins": "begins; its results go to",
    "the map is resumed": "map resumed after restart",
}
"""Lines of the journal by step."""
FIRST_POSE = "the first pose"


class _Spent:
    """CPU time by process of a daemon, sampled; its stages keep their names."""

    def __init__(self, pid: int) -> None:
        self.by_time: list[tuple[int, dict[str, float]]] = []
        self._daemon, self._over = psutil.Process(pid), threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._over.wait(EVERY_S):
            spent: dict[str, float] = {}
            for process in (self._daemon, *self._daemon.children(recursive=True)):
                with contextlib.suppress(psutil.Error):
                    times = process.cpu_times()
                    name = "daemon" if process is self._daemon else process.name()
                    spent[name] = spent.get(name, 0.0) + times.user + times.system
            self.by_time.append((time.monotonic_ns(), spent))

    def until(self, t_ns: int) -> dict[str, float]:
        """Seconds by process up to a time."""
        before = [spent for at_ns, spent in self.by_time if at_ns <= t_ns]
        return before[-1] if before else {}

    def close(self) -> None:
        self._over.set()
        self._thread.join()


def restarted(flying: Flying, cores: set[int], own: set[int]) -> tuple[dict[str, float], list[str]]:
    """Seconds from the start of the new process to each step; rows of what was spent."""
    flying.until_sending()
    time.sleep(KEPT_S)
    os.sched_setaffinity(0, cores)  # which the daemon inherits
    flying.start_again(signal.SIGKILL)
    os.sched_setaffinity(0, own)
    began_ns = flying.daemon.started_ns
    spent = _Spent(flying.daemon.pid)
    reached_ns = {
        step: flying.daemon.line(text, after_ns=began_ns).monotonic_ns
        for step, text in STEPS.items()
    }
    (first,) = flying.autopilot.wait_for(
        "ODOMETRY", 1, 60.0, lambda got: got.monotonic_ns >= began_ns
    )
    reached_ns[FIRST_POSE] = first.monotonic_ns
    spent.close()
    rows = []
    for step, at_ns in reached_ns.items():
        by_name = sorted(spent.until(at_ns).items(), key=lambda row: -row[1])
        parts = ", ".join(f"{name} {1000 * s:.0f}" for name, s in by_name if s > 0)
        rows.append(f"  {(at_ns - began_ns) * 1e-9:6.2f} s {step}; CPU ms: {parts}")
    return {step: (at_ns - began_ns) * 1e-9 for step, at_ns in reached_ns.items()}, rows


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--cores", type=int, default=os.cpu_count(), help="of the daemon")
    parser.add_argument("--set", action="append", default=[], help="a setting more")
    arguments = parser.parse_args()
    every = sorted(os.sched_getaffinity(0))
    cores, own = set(every[: arguments.cores]), set(every[-1:]) | set(every[arguments.cores :])
    path = Halting()
    runs = []
    with (
        contextlib.redirect_stdout(sys.stderr),
        tempfile.TemporaryDirectory() as folder,
        Flying(Path(folder), *arguments.set, path=path) as flying,
    ):
        flying.until_source("camera", "running")
        flying.until_source("autopilot", "running")
        flying.take_off()
        time.sleep(KEPT_S)
        path.hover()
        for n in range(arguments.rounds):
            run, rows = restarted(
                flying, cores, own if arguments.cores < len(every) else set(every)
            )
            runs.append(run)
            print(f"round {n + 1}", *rows, sep="\n")
    print_steps(runs)
    return 0


if __name__ == "__main__":
    sys.exit(main())
