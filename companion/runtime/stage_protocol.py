"""Control messages between the daemon and the process of a stage."""

from __future__ import annotations

import contextlib
import pickle
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from companion.config import Config
from companion.errors import CompanionError, InputError, StageError
from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.messages.run_facts import RunFacts


@dataclass(frozen=True, slots=True)
class Setup:
    """First message to a stage; those that begin with the flight get its folder.

    `origin` is that of local NED where it is known before the flight, as in a recorded one, and
    `is_live` whether the flight is flown just now: then no frame waits for mapping, and a queue
    that is full drops; else nothing is lost.
    """

    config: Config
    camera: Camera
    folder: Path | None = None
    viewer_file: str = "flight.rrd"
    """Name of the viewer's recording in the folder."""
    origin: GeoOrigin | None = None
    is_live: bool = True
    failed_devices: Mapping[str, str] = field(default_factory=dict)
    """OpenCL devices that have failed in this flight, by identity, and how, in words."""


@dataclass(frozen=True, slots=True)
class SaveSiteMap:
    """Localisation writes the map of the site into `folder` at the end, by the flight's name.

    `origin` is that of local NED, None where unknown.
    """

    folder: Path
    flight: str
    origin: GeoOrigin | None


@dataclass(frozen=True, slots=True)
class Finish:
    """Last message to a stage: give the last results.

    With `hurry` slow results are left out. `results` gets the facts of its report. With `keep_map`
    the vehicle flies on, and another process may continue the map. `viewers` waits for `n_viewers`
    at least to have received everything.
    """

    hurry: bool
    facts: RunFacts | None = None
    keep_map: bool = False
    n_viewers: int = 0
    save_map: SaveSiteMap | None = None
    """For `localisation`."""


@dataclass(frozen=True, slots=True)
class KeepMap:
    """Localisation keeps its map in a file, and with `take_up` resumes the map found there."""

    path: Path
    take_up: bool


@dataclass(frozen=True, slots=True)
class SetLoadLevel:
    """Share of its work that a stage is to do, 0 to 1; see companion.runtime.governor."""

    level: float


@dataclass(frozen=True, slots=True)
class SetBudget:
    """Limit the rate of all viewers together; 0 for no limit. For `viewers`."""

    kbit_s: float


@dataclass(frozen=True, slots=True)
class TakeSnapshot:
    """Write the cloud as it is now; `origin` where the world's is known. For `results`."""

    number: int
    origin: GeoOrigin | None = None


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Progress of a snapshot; finished with a `path`, or failed with `why_not`."""

    number: int
    percent: int = 0
    path: str = ""
    n_points: int = 0
    why_not: str = ""


@dataclass(frozen=True, slots=True)
class WriteResults:
    """Write the results of the flight so far, which goes on. For `results`."""

    facts: RunFacts


@dataclass(frozen=True, slots=True)
class ResultsWritten:
    """The results so far lie in `folder`, or could not be written: `why_not`."""

    folder: str
    why_not: str = ""


@dataclass(frozen=True, slots=True)
class Progress:
    """Periodic report of a stage's process.

    `busy_since_s` is the begin of its present step (CLOCK_MONOTONIC, the same for all processes of
    a computer); None while it waits for work.
    """

    n_done: int = 0
    n_dropped: int = 0
    busy_since_s: float | None = None
    waiting_bytes: int = 0
    times: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    device: str = ""
    details: Mapping[str, Any] = field(default_factory=dict)
    peak_memory_mb: float = 0.0
    """Of a process that has only this stage."""


@dataclass(frozen=True, slots=True)
class Taken:
    """Bytes of shared memory that the process has taken from its socket so far."""

    n_bytes: int


@dataclass(frozen=True, slots=True)
class Remark:
    """A line of text for the user, on a device that was refused, say."""

    text: str


@dataclass(frozen=True, slots=True)
class Listening:
    """Port where `viewers` serves viewers of this machine."""

    port: int


@dataclass(frozen=True, slots=True)
class DriverAtWork:
    """A device's driver is at work, and may end the process; or no longer ("").

    `identity` and `named` are those of the device.
    """

    identity: str = ""
    named: str = ""


@dataclass(frozen=True, slots=True)
class Failed:
    """The stage cannot do its work and ends: the reason, and whether user input is to blame.

    `is_foreseen` is False for a bug. `pickled` is the exception, None where it cannot be pickled.
    """

    why: str
    by_input: bool = False
    is_foreseen: bool = True
    pickled: bytes | None = None

    @classmethod
    def by(cls, error: BaseException) -> Failed:
        """Told of an exception."""
        is_foreseen = isinstance(error, CompanionError | OSError)
        why = str(error) if is_foreseen else f"{type(error).__name__}: {error}"
        pickled = None
        with contextlib.suppress(Exception):  # some cannot be, and say so in any way
            whole = pickle.dumps(error)
            pickle.loads(whole)
            pickled = whole
        return cls(why, isinstance(error, InputError), is_foreseen, pickled)

    def error(self) -> BaseException:
        """The exception, or one with its text."""
        if self.pickled is None:
            return StageError(self.why)
        found: BaseException = pickle.loads(self.pickled)
        return found


@dataclass(frozen=True, slots=True)
class Finished:
    """All results are given, and the last progress told."""
