"""Trials in slowed time: to them a computer that is too slow for real time is fast enough.

Firmware, camera, companion and ground station read the same slower clock (`slowed_time.c`), so that
each second of theirs has more of the processor; by a factor of two the computer is twice as fast.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

TOLD = "SLOWED_TIME"
SOURCE = Path(__file__).with_suffix(".c")


def slowed_by() -> float:
    """How many true seconds pass in one of this process."""
    return float(os.environ.get(TOLD, "1").split()[0])


def run_again_slowed(factor: float, folder: Path) -> None:
    """Become this very command in slowed time; nothing if it is that already."""
    if TOLD in os.environ or factor == 1.0:
        return
    compiler = shutil.which("cc")
    if compiler is None:
        sys.exit("slowed time wants a C compiler: apt install gcc")
    folder.mkdir(parents=True, exist_ok=True)
    library = (folder / "slowed_time.so").resolve()
    subprocess.run([compiler, "-O2", "-shared", "-fPIC", "-o", library, SOURCE, "-ldl"], check=True)
    os.environ["LD_PRELOAD"] = str(library)
    os.environ[TOLD] = f"{factor:g} {time.time_ns()} {time.monotonic_ns()}"
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
