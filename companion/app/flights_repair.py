"""companion flights repair: adds the missing end to recordings that were cut short."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

from companion.app.progress import Progress
from companion.errors import FlightError
from companion.timing.clock import wait_s
from drivers.recording.repair import in_place, unfinished

MB = 1 << 20
STEP_BYTES, REST_S = 4 * MB, 0.1
"""Bytes read between two pauses with --gently."""


def repair_flights(
    paths: Sequence[Path], progress: Progress, gently: bool = False
) -> Iterator[tuple[str, bool]]:
    """One line for each recording that was cut short, and whether it is whole now.

    Passes over whole recordings, those being written, and files that are no recordings.
    """
    found = [path for path in paths if _is_unfinished(path)]
    progress.start(max(1, sum(path.stat().st_size for path in found) // MB))
    before, never = 0, threading.Event()
    for path in found:
        rested = 0

        def on_progress(n_bytes: int, before: int = before) -> None:
            nonlocal rested
            progress.update((before + n_bytes) // MB, "read", 0)
            if gently and n_bytes - rested >= STEP_BYTES:
                rested = n_bytes
                wait_s(never, REST_S)

        mended = in_place(path, on_progress)
        before += path.stat().st_size
        yield _in_words(path, mended), mended is not None
    progress.finish()


def _is_unfinished(path: Path) -> bool:
    try:
        return unfinished(path)
    except FlightError:
        return False


def _in_words(path: Path, n_cut_bytes: int | None) -> str:
    if n_cut_bytes is None:
        return f"{path}: cannot be repaired: it may not be written, or the disk is full"
    return f"{path}: repaired, {n_cut_bytes} bytes at its end were not whole"
