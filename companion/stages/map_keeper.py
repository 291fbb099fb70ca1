"""Checkpoint file of a flight's map, from which another process resumes in the air.

Where possible it lies in memory, so that it survives the process but not a reboot: systemd's
RuntimeDirectory. Writing a few megabytes each second then wears nothing out. It is not synchronised
to disk.
"""

from __future__ import annotations

import errno
import os
import stat
import threading
from pathlib import Path
from typing import NamedTuple

from companion.estimation.resumption.checkpoint import (
    Checkpoint,
    CheckpointError,
    decode,
    encode,
    fingerprint,
    read_arrays,
)
from companion.estimation.resumption.map_verification import MAX_ABSENT_NS
from companion.products.atomic_file import write_atomically
from companion.runtime.stage_protocol import Setup
from companion.timing.clock import since_boot_ns
from drivers.system.computer_boot import computer_boot

MOST_READ_BYTES = 64_000_000
"""Larger than any checkpoint."""


class Kept(NamedTuple):
    """A checkpoint, the time of its last frame by `since_boot_ns`, and the bytes of its file."""

    checkpoint: Checkpoint
    tracked_ns: int
    data: bytes


class MapKeeper:
    """Writes checkpoints in a thread of its own.

    The thread has the process's priority: with a lower one it could be preempted while it holds the
    interpreter lock, and delay the pose.
    """

    def __init__(self, path: Path, setup: Setup) -> None:
        self._path, self._setup = path, setup
        same = fingerprint(setup.config, setup.camera)
        self._same = {"fingerprint": same, "boot": computer_boot()}
        self._waiting: tuple[Checkpoint, int] | None = None
        self._closed = False
        self._changed = threading.Condition()
        self.fault = ""
        """Reason why nothing can be written; "" without one."""
        self._thread = threading.Thread(target=self._work, name="map keeper", daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """True while the last one is still being written."""
        return self._waiting is not None

    def put(self, checkpoint: Checkpoint) -> None:
        """Write a checkpoint, whose last frame has just been tracked; never waits."""
        with self._changed:
            self._waiting = checkpoint, since_boot_ns()
            self._changed.notify()

    def take(self) -> Kept | None:
        """Checkpoint of another process; None without one, CheckpointError if unusable.

        It is removed at once: should it crash this process, too, the next one begins without.
        """
        try:
            self._be_ours()
            with self._path.open("rb") as file:
                data = file.read(MOST_READ_BYTES)
            self._path.unlink()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise CheckpointError(f"{self._path}: {error.strerror or error}") from error
        try:
            return self._checked(data)
        except CheckpointError as error:
            raise CheckpointError(f"{self._path}: {error}") from error

    def _checked(self, data: bytes) -> Kept:
        said, arrays = read_arrays(data)
        if said["boot"] != self._same["boot"]:
            raise CheckpointError("the computer was started anew since")
        if said["fingerprint"] != self._same["fingerprint"]:
            others = "camera, calibration, feedback.mode or telemetry.use"
            raise CheckpointError(f"{others} are others now")
        age_ns = since_boot_ns() - said["tracked_ns"]
        if not 0 <= age_ns <= MAX_ABSENT_NS:
            raise CheckpointError(f"it is {age_ns * 1e-9:.0f} s old")
        features = self._setup.config.features
        checkpoint = decode(arrays, self._setup.camera, features.scale_factor)
        return Kept(checkpoint, said["tracked_ns"], data)

    def close(self, forget: bool) -> None:
        """End writing; with `forget` remove the file."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()
        if forget:
            self._remove()

    def _be_ours(self) -> None:
        """OSError where other users could have written the file."""
        folder = self._path.parent.stat()
        if folder.st_uid not in (os.getuid(), 0) or folder.st_mode & stat.S_IWOTH:
            raise PermissionError(errno.EPERM, "its folder is not ours alone")

    def _remove(self) -> None:
        try:
            self._path.unlink(missing_ok=True)
        except OSError as error:
            self.fault = f"{self._path}: {error.strerror or error}"

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._waiting is not None)
                if self._closed or self._waiting is None:
                    return
                checkpoint, tracked_ns = self._waiting
            try:
                self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
                self._be_ours()
                remarks = self._same | {"tracked_ns": tracked_ns}
                write_atomically(self._path, encode(checkpoint, remarks))
                self.fault = ""
            except OSError as error:
                self.fault = f"{self._path}: {error.strerror or error}"
            with self._changed:
                self._waiting = None
