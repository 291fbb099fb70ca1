"""Append-only file with a lock that marks it as unfinished."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

from companion.products.atomic_file import sync


class GrowingFile:
    """A new file; OSError where it exists or cannot be made.

    Its lock ends with the process, however that ends: see `is_growing`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        fcntl.flock(self._fd, fcntl.LOCK_EX)  # a check by `is_growing` holds it for a moment only
        self._size = 0
        for folder in (path.parent, path.parent.parent):
            sync(folder)  # else a power cut could leave a file without a name

    def append(self, data: bytes) -> None:
        """Append all of it; OSError, and none of it stays, where there is no space."""
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.write(self._fd, rest) :]
        except OSError:
            os.ftruncate(self._fd, self._size)
            os.lseek(self._fd, self._size, os.SEEK_SET)
            raise
        self._size += len(data)

    def sync(self) -> None:
        """Wait until the data is on disk."""
        os.fdatasync(self._fd)

    def discard(self) -> None:
        """Close it and delete it."""
        self.close()
        self._path.unlink(missing_ok=True)

    def close(self) -> None:
        """Close it; can be called twice."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)


def is_growing(fd: int) -> bool:
    """True while another process writes to the file that is open as `fd`."""
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    fcntl.flock(fd, fcntl.LOCK_UN)
    return False
