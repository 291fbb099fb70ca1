"""A part of a trial as a process of its own, ended with it."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def child(module: str, said: Path, nice: int, *words: object) -> Iterator[subprocess.Popen[bytes]]:
    """Run one of these modules at a priority; what it says goes to a file, orders to its input."""
    command = ["nice", "-n", str(nice), sys.executable, "-m", f"tests.firmware.{module}"]
    with said.open("wb") as out:
        process = subprocess.Popen(
            [*command, *map(str, words)], stdin=subprocess.PIPE, stdout=out, stderr=out
        )
        try:
            yield process
        finally:
            process.terminate()
            process.communicate()
