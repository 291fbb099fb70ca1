"""A command whose output nobody reads any more, as behind `| head -1` once that has its line."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path


def into_closed_pipe(*arguments: str | Path) -> tuple[int, str]:
    """Exit status and standard error of `companion ARGUMENTS` that writes into such a pipe.

    Buffered, as for users: argparse does not mind that its own --help cannot be written at once.
    """
    environment = {key: each for key, each in os.environ.items() if key != "PYTHONUNBUFFERED"}
    reader, writer = os.pipe()
    os.close(reader)
    try:
        ended = subprocess.run(
            [sys.executable, "-m", "companion", *map(str, arguments)],
            stdout=writer, stderr=subprocess.PIPE, text=True, timeout=120, env=environment,
            check=False,
        )  # fmt: skip
    finally:
        os.close(writer)
    return ended.returncode, ended.stderr
