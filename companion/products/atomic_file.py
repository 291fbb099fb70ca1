"""Atomic file writes."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path


def write_atomically(
    path: Path, data: bytes | Iterable[bytes], durable: bool = False, like: Path | None = None,
    mode: int = 0o666,
) -> None:  # fmt: skip
    """Put `data`, whole or in parts, at `path`, replacing the old file in one step.

    Raises OSError that names `path`. A failed write leaves the old file as it was, and no partial
    file. With `durable` it waits until the data is on disk, and so survives a loss of power. Owner
    and mode are those of `like`, if any; else it is created with `mode`, less the umask.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        part.unlink(missing_ok=True)  # one left by a crash has the mode that it was created with
        with open(part, "wb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
            if like is not None:
                theirs, own = like.stat(), os.fstat(file.fileno())
                # not for nothing: a service may be forbidden the call
                if (own.st_uid, own.st_gid) != (theirs.st_uid, theirs.st_gid):
                    os.fchown(file.fileno(), theirs.st_uid, theirs.st_gid)
                os.fchmod(file.fileno(), stat.S_IMODE(theirs.st_mode))
            for some in [data] if isinstance(data, bytes) else data:
                file.write(some)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        os.replace(part, path)
        if durable:
            sync(path.parent)
    except BaseException as error:
        with suppress(OSError):  # the reason is what stopped the writing, not this
            part.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno is not None:
            error.filename = str(path)
        raise


def sync(path: Path) -> None:
    """Wait until the disk has what was written to a file, or the names in a folder."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
