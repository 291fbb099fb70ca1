"""Latest-wins file writer beside the event loop."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

from companion.products.atomic_file import sync, write_atomically


class NewestFile:
    """A file of which only the newest content counts, written in a thread of its own.

    A disk that hangs delays nothing and costs no more memory. `failed` is called in that thread
    with the error.
    """

    def __init__(self, path: Path, failed: Callable[[str], None]) -> None:
        self.path, self._failed = path, failed
        self._changed = threading.Condition()
        self._newest: bytes | None = None
        self._due = self._busy = self._closed = False
        threading.Thread(target=self._run, name=f"write {path.name}", daemon=True).start()

    def put(self, data: bytes | None) -> None:
        """Set the content of the file; None deletes it."""
        with self._changed:
            self._newest, self._due = data, True
            self._changed.notify_all()

    def wait(self, seconds: float) -> bool:
        """Wait until all is written, at most this long; whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: not (self._due or self._busy), seconds)

    def close(self, seconds: float = 0.0) -> None:
        """Write the rest and end; waits for it at most this long."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self.wait(seconds)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._busy = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._due or self._closed)
                if not self._due:
                    return
                data, self._due, self._busy = self._newest, False, True
            try:
                self._write(data)
            except OSError as error:
                self._failed(f"{self.path}: {error.strerror}")

    def _write(self, data: bytes | None) -> None:
        if data is None:
            self.path.unlink(missing_ok=True)
        else:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            # the rename makes it survive a crash of the process at once, the synchronisation, which
            # may take long, a loss of power
            write_atomically(self.path, data)
            sync(self.path)
        sync(self.path.parent)
