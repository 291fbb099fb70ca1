"""Reset counter last sent to an autopilot, kept on disk for the next process.

It is written before the first pose that has it is sent: the kept counter may be ahead of what was
sent, never behind. A thread of its own waits for the disk.
"""

from __future__ import annotations

import dataclasses
import json
import os
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.estimation.gate.reset_counter import BootIdentity
from companion.products.atomic_file import write_atomically

NAME = "sent_poses.json"


@dataclass(frozen=True, slots=True)
class KeptCounter:
    """Last counter sent in one boot of the autopilot."""

    boot: BootIdentity
    reset_counter: int
    home_down_m: float | None = None
    """Position of home on its local frame's down axis; see `drivers.mavlink.autopilot_height`."""


def counter_path(flights: str, environment: Mapping[str, str] = os.environ) -> Path:
    """Path in the service's state directory, else beside the folder of flights."""
    state = environment.get("STATE_DIRECTORY", "").split(":")[0]
    return (Path(state) if state else Path(flights).parent) / NAME


def read_counter(path: Path) -> KeptCounter | None:
    """Content of the file; None where there is none. OSError, ValueError where unreadable."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    try:
        found: dict[str, Any] = json.loads(data)
        boot = found["boot"]
        home = found["home_down_m"]
        return KeptCounter(
            BootIdentity(
                int(boot["system_id"]), float(boot["autopilot_s"]), float(boot["monotonic_s"]),
                float(boot["unix_s"]), str(boot["computer"]),
            ),
            int(found["reset_counter"]), None if home is None else float(home),
        )  # fmt: skip
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"it does not hold what it should: {error!r}") from error


class CounterFile:
    """Writes the file; `ask` never waits. To be used from one thread."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.Lock()
        self._wanted: KeptCounter | None = None
        self._writing = False
        self._written: KeptCounter | None = None
        self._failed: tuple[KeptCounter, str] | None = None

    def ask(self, kept: KeptCounter) -> None:
        """Write this; skips an older request that still waits."""
        with self._lock:
            self._wanted = kept
            if self._writing:
                return
            self._writing = True
        threading.Thread(target=self._write, name="reset counter", daemon=True).start()

    def has(self, kept: KeptCounter) -> bool:
        """True if this counter is on disk."""
        with self._lock:
            return self._written == kept

    def trouble_with(self, kept: KeptCounter) -> str:
        """Reason why it could not be written; "" if written, or still waiting."""
        with self._lock:
            return self._failed[1] if self._failed is not None and self._failed[0] == kept else ""

    def _write(self) -> None:
        while True:
            with self._lock:
                kept, self._wanted = self._wanted, None
                self._writing = kept is not None
            if kept is None:
                return
            data = json.dumps(dataclasses.asdict(kept), indent=1).encode()
            try:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(self.path, data, durable=True)
            except OSError as error:
                with self._lock:
                    self._failed = kept, str(error)
            else:
                with self._lock:
                    self._written = kept
