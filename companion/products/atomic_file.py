"""Atomic file writes."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path


def write_atomically(path: Path, data: bytes | Iterable[bytes], durable: bool = False) -> None:
    """Put `data`, whole or in parts, at `path`, replacing the old file in one step.

    Raises OSError. A failed write leaves the old file as it was, and no partial file. With
    `durable` it waits until the data is on disk, and so survives a loss of power.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        with part.open("wb") as file:
            for some in [data] if isinstance(data, bytes) else data:
                file.write(some)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        os.replace(part, path)
        if durable:
            sync(path.parent)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def sync(path: Path) -> None:
    """Wait until the disk has what was written to a file, or the names in a folder."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
