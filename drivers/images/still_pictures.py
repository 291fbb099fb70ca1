"""Single images of the camera kept as files, on request: in a thread, so that no frame waits."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2

from companion.messages import Frame
from companion.products.atomic_file import write_atomically

NAME = re.compile(r"image-(\d{6})\.jpg")
QUALITY = 95
MB, MIB = 10**6, 1 << 20


@dataclass(frozen=True, slots=True)
class Still:
    """An image taken: its number, and its file; `why` is "" unless it could not be kept."""

    number: int
    t_ns: int
    path: Path
    why: str = ""


@dataclass(frozen=True, slots=True)
class Storage:
    """Disk of the images, MiB; less is available than is free where some of it is reserved."""

    total_mib: float
    used_mib: float
    available_mib: float


class StillPictures:
    """Takes the next frame after a request into `folder`; refused below `least_free_mb` of disk."""

    def __init__(self, folder: Path, least_free_mb: float) -> None:
        self.folder, self._least_free_mb = folder, least_free_mb
        self._lock = threading.Lock()
        self._wanted: Callable[[Still], None] | None = None
        self._writing = False
        self._newest: int | None = None

    @property
    def n_taken(self) -> int:
        """Number of the newest image; 0 without any."""
        if self._newest is None:
            self._newest = max(self._numbers(), default=0)
        return self._newest

    @property
    def storage(self) -> Storage | None:
        """Disk that has the folder, or will have it; None where it cannot be looked at."""
        folder = next((p for p in (self.folder, *self.folder.parents) if p.is_dir()), Path("/"))
        try:
            found = os.statvfs(folder)
        except OSError:
            return None
        block_mib = found.f_frsize / MIB
        available_mib = found.f_bavail * block_mib - self._least_free_mb * MB / MIB
        return Storage(
            found.f_blocks * block_mib, (found.f_blocks - found.f_bfree) * block_mib,
            max(0.0, available_mib),
        )  # fmt: skip

    def request(self, done: Callable[[Still], None]) -> bool:
        """Keep the next frame; `done` is called in another thread. False while one is awaited."""
        with self._lock:
            if self._wanted is not None or self._writing:
                return False
            self._wanted = done
            return True

    def frame(self, frame: Frame) -> None:
        """Take a frame; from the camera's thread."""
        if self._wanted is None:
            return
        with self._lock:
            done, self._wanted = self._wanted, None
            self._writing = done is not None
        if done is not None:
            threading.Thread(
                target=self._keep, args=(frame, done), name="still", daemon=True
            ).start()

    def _keep(self, frame: Frame, done: Callable[[Still], None]) -> None:
        number = self.n_taken + 1
        path, why = self.folder / f"image-{number:06}.jpg", ""
        try:
            bgr = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR) if frame.rgb.size else frame.grey
            _, jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
            storage = self.storage
            if storage is None or storage.available_mib <= 0:
                why = "the disk is full"
            else:
                self.folder.mkdir(parents=True, exist_ok=True)
                write_atomically(path, jpeg.tobytes(), durable=True)
                self._newest = number
        except OSError as error:
            why = error.strerror or str(error)
        with self._lock:
            self._writing = False
        done(Still(number, frame.t_ns, path, why))

    def _numbers(self) -> list[int]:
        try:
            names = os.listdir(self.folder)
        except OSError:
            return []
        return [int(found[1]) for name in names if (found := NAME.fullmatch(name))]
