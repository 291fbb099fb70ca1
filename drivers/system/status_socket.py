"""Unix socket of the daemon's status: one JSON document per connection.

It lies in a folder that only its owner's group can enter. A lock beside it is held as long as the
daemon lives, so that a second daemon is refused, and a socket without a held lock was left behind
by a killed one.
"""

from __future__ import annotations

import asyncio
import fcntl
import json
import os
import socket
import stat
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from companion.errors import ConfigError, SourceError
from drivers.system.short_answers import ShortAnswers

NAME = "status.sock"
SERVICE_FOLDER = Path("/run/companion")
"""RuntimeDirectory of the service."""
MAX_PATH = 107
"""Length limit of a unix socket's address."""
MAX_DOCUMENT = 4 << 20


def own_socket_path(setting: str, environment: Mapping[str, str] = os.environ) -> Path:
    """Path of a daemon's socket; `setting` is `expert.daemon.socket`."""
    return Path(setting) if setting != "auto" else _own_folders(environment)[0] / NAME


def found_socket_path(setting: str, environment: Mapping[str, str] = os.environ) -> Path:
    """Path of a running daemon's socket; the service's own first."""
    if setting != "auto":
        return Path(setting)
    places = [folder / NAME for folder in (SERVICE_FOLDER, *_own_folders(environment))]
    return next((path for path in places if _exists(path)), places[0])


def _own_folders(environment: Mapping[str, str]) -> list[Path]:
    folders = []
    if environment.get("RUNTIME_DIRECTORY"):
        folders.append(Path(environment["RUNTIME_DIRECTORY"].split(":")[0]))
    if environment.get("XDG_RUNTIME_DIR"):
        folders.append(Path(environment["XDG_RUNTIME_DIR"]) / "companion")
    folders.append(Path(tempfile.gettempdir()) / f"companion-{os.getuid()}")
    return folders


def _exists(path: Path) -> bool:
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:  # a folder that may not be entered: asking there says so
        return True
    return True


class StatusSocket:
    """Answers each connection with a document; `warn` takes faults in making one."""

    def __init__(
        self, path: Path, document: Callable[[], Mapping[str, Any]], warn: Callable[[str], None]
    ) -> None:
        self.path = path
        self._document = document
        self._warn = warn
        self._lock_fd: int | None = None
        self._answers: ShortAnswers | None = None

    async def start(self) -> None:
        """Lock and listen. ConfigError where impossible."""
        try:
            _private_folder(self.path.parent)
            self._lock_fd = _lock(self.path)
            listening = _bind(self.path)
        except OSError as error:
            self._unlock()
            reason = error.strerror or error
            raise ConfigError(f"expert.daemon.socket: {self.path}: {reason}") from error
        except ConfigError:
            self._unlock()
            raise
        self._answers = ShortAnswers(listening, self._answer, self._warn)
        await self._answers.start()

    async def stop(self) -> None:
        """Stop listening and leave nothing behind but the lock file."""
        if self._answers is None:
            return
        self.path.unlink(missing_ok=True)
        await self._answers.stop()
        self._answers = None
        self._unlock()

    async def _answer(self, reader: asyncio.StreamReader) -> bytes:
        return json.dumps(self._document(), allow_nan=False).encode() + b"\n"

    def _unlock(self) -> None:
        if self._lock_fd is not None:
            os.close(self._lock_fd)
            self._lock_fd = None


def _private_folder(folder: Path) -> None:
    """Create a folder for its owner alone; one that others could have made is refused."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    state = folder.stat()
    if state.st_uid not in (os.getuid(), 0):
        raise ConfigError(f"expert.daemon.socket: {folder}: belongs to another user; set another")
    if state.st_mode & stat.S_IWOTH and not state.st_mode & stat.S_ISVTX:
        raise ConfigError(f"expert.daemon.socket: {folder}: anyone may write there; set another")


def _lock(path: Path) -> int:
    # Of the kind that a child process does not inherit: one that outlives a killed daemon must not
    # keep the next daemon out.
    lock = path.with_name(path.name + ".lock")
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
    fd = os.open(lock, flags, 0o600)
    try:
        fcntl.lockf(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError) as error:
        os.close(fd)
        raise ConfigError(
            f"expert.daemon.socket: {path}: another companion runs here already; stop it, or set"
            " expert.daemon.socket"
        ) from error
    return fd


def _bind(path: Path) -> socket.socket:
    if len(os.fsencode(path)) > MAX_PATH:
        raise ConfigError(f"expert.daemon.socket: {path}: longer than {MAX_PATH} bytes")
    if path.is_symlink() or path.exists():
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise ConfigError(f"expert.daemon.socket: {path}: is there and is no socket")
        path.unlink()
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        listening.bind(str(path))
        path.chmod(0o660)
    except OSError:
        listening.close()
        raise
    return listening


def ask_status(path: Path, timeout_s: float = 3.0) -> dict[str, Any]:
    """Status document of the running daemon. SourceError without one."""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
            asking.settimeout(timeout_s)
            asking.connect(str(path))
            received = bytearray()
            while chunk := asking.recv(65536):
                received += chunk
                if len(received) > MAX_DOCUMENT:
                    raise SourceError(f"{path}: what answers there is no companion")
    except (FileNotFoundError, ConnectionRefusedError) as error:
        raise SourceError(
            f"no daemon runs (nothing answers at {path}); `companion run` starts one, --set"
            " expert.daemon.socket=PATH names another place"
        ) from error
    except PermissionError as error:
        raise SourceError(
            f"{path}: may not be asked by this user; join the group companion, or use sudo"
        ) from error
    except TimeoutError as error:
        raise SourceError(
            f"{path}: a daemon is there but has not answered in {timeout_s:g} s"
        ) from error
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror or error}") from error
    try:
        document = json.loads(received)
    except ValueError as error:
        raise SourceError(f"{path}: the answer is incomplete; ask again") from error
    if not isinstance(document, dict):
        raise SourceError(f"{path}: what answers there is no companion")
    return document
