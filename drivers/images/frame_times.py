"""Exposure times of frames: `frames.csv`, lines of `index,unix_ns`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from companion.errors import FlightError
from companion.messages import Warned

HEADER = "index,unix_ns"


def read_frame_times(path: Path) -> tuple[list[int], list[int], list[Warned]]:
    """Indices and times, both increasing, and warnings; FlightError for no such list.

    An incomplete last line is ignored, and so is a frame stamped no later than the last.
    """
    try:
        lines = path.read_text("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise FlightError(f"{path}: cannot be read as text: {error}") from error
    if not lines or [word.strip() for word in lines[0].split(",")][:2] != HEADER.split(","):
        raise FlightError(f'{path}: the first line must be "{HEADER}"')
    indices: list[int] = []
    times_ns: list[int] = []
    warnings = []
    n_backward = 0
    for number, line in enumerate(lines[1:], 2):
        if not line.strip():
            continue
        row = _row(line)
        if row is None or (indices and row[0] <= indices[-1]):
            if number == len(lines):
                warnings.append(
                    Warned(
                        times_ns[-1] if times_ns else 0, "the last line of frames.csv is damaged"
                    )
                )
                break
            raise FlightError(
                f"{path}, line {number}: wanted an increasing index and a time in whole "
                f"nanoseconds, found {line[:60]!r}"
            )
        if times_ns and row[1] <= times_ns[-1]:
            n_backward += 1
            continue
        indices.append(row[0])
        times_ns.append(row[1])
    if not indices:
        raise FlightError(f"{path}: there is no frame in it")
    if n_backward:
        warnings.append(
            Warned(times_ns[0], "frames out of order left out", f"{n_backward} in frames.csv")
        )
    return indices, times_ns, warnings


def _row(line: str) -> tuple[int, int] | None:
    words = line.split(",")
    try:
        index, t_ns = int(words[0]), int(words[1])
    except (ValueError, IndexError):
        return None
    return (index, t_ns) if index >= 0 and 0 <= t_ns <= np.iinfo(np.int64).max else None
