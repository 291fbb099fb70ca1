"""Memory of the daemon and its stages right after their imports, with what they share and without.

    python -m tests.bench.shared_imports

Processes are forked as the daemon's fork server forks them, once with
`companion.daemon.shared_imports` made before and once without. Proportional set sizes (PSS), MB; of
the stages those that need no compiled loops.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import os
import signal
import subprocess
import sys
from pathlib import Path

STAGES = ("viewers", "recorder", "results", "depth", "landing")


def pss_mb(pid: int) -> float:
    """Proportional set size of a process."""
    text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    return int(text.split("\nPss:")[1].split()[0]) / 1e3


def measured(shares: bool) -> dict[str, float]:
    """PSS by process; called once in a process of its own, which is the daemon here."""
    gc.disable()
    importlib.import_module("companion.app.cli.flying")
    importlib.import_module("companion.runtime.fork_server_process")
    if shares:
        importlib.import_module("companion.daemon.shared_imports")
    gc.freeze()
    done, is_done = os.pipe()
    pids = {}
    for name in ("fork server", *STAGES):
        pid = os.fork()
        if pid == 0:
            if name in STAGES:
                gc.enable()
                importlib.import_module(f"companion.stages.{name}_work")
            os.write(is_done, b".")
            signal.pause()
        pids[name] = pid
    gc.enable()
    importlib.import_module("companion.daemon.daemon")
    n_done = 0
    while n_done < len(pids):
        n_done += len(os.read(done, len(pids)))
    found = {name: pss_mb(pid) for name, pid in (*pids.items(), ("daemon", os.getpid()))}
    for pid in pids.values():
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--of", choices=("shared", "alone"), help="one of both, in this process")
    which = parser.parse_args().of
    if which is None:
        for each in ("alone", "shared"):
            subprocess.run([sys.executable, "-m", __spec__.name, "--of", each], check=True)
        return 0
    found = measured(which == "shared")
    parts = ", ".join(f"{name} {mb:.0f}" for name, mb in found.items())
    print(f"{which}: {sum(found.values()):.0f} MB ({parts})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
