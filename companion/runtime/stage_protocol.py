"""What passes between the daemon and the process of a stage, beside the messages themselves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from companion.config import Config
from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.products.flight_result import RunFacts


@dataclass(frozen=True, slots=True)
class Setup:
    """The first thing a stage's process is told; recorder and results get the flight's folder."""

    config: Config
    camera: Camera
    folder: Path | None = None
    failed_devices: Mapping[str, str] = field(default_factory=dict)
    """OpenCL devices that have failed in this flight, by identity, and how, in words."""


@dataclass(frozen=True, slots=True)
class Finish:
    """The last thing it is told: give the last results.

    With `hurry` what takes long is left out. `results` gets the facts of its report. With
    `keep_map` the vehicle flies on, and another process may go on with the map.
    """

    hurry: bool
    facts: RunFacts | None = None
    keep_map: bool = False


@dataclass(frozen=True, slots=True)
class KeepMap:
    """Have localisation keep its map in a file; and take up what is in it, if so said."""

    path: Path
    take_up: bool


@dataclass(frozen=True, slots=True)
class SetLoadLevel:
    """How much of its work a stage is to do, 0 to 1; see companion.runtime.governor."""

    level: float


@dataclass(frozen=True, slots=True)
class TakeSnapshot:
    """Have `results` write the cloud as it is now; `origin` where the world has a known one."""

    number: int
    origin: GeoOrigin | None = None


@dataclass(frozen=True, slots=True)
class Snapshot:
    """How far a snapshot is; it is over when it has a `path`, or `why_not` says that it failed."""

    number: int
    percent: int = 0
    path: str = ""
    n_points: int = 0
    why_not: str = ""


@dataclass(frozen=True, slots=True)
class Progress:
    """What a stage's process says of itself, every second or so, whatever it is at.

    `busy_since_s` is when the step began that it is in (CLOCK_MONOTONIC, the same for all processes
    of a computer); None while it waits for work.
    """

    n_done: int = 0
    n_dropped: int = 0
    busy_since_s: float | None = None
    waiting_bytes: int = 0
    times: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    device: str = ""


@dataclass(frozen=True, slots=True)
class DriverAtWork:
    """From now on a device's driver is at work, in which it may end the process; or no more ("").

    `identity` and `named` are those of the device.
    """

    identity: str = ""
    named: str = ""


@dataclass(frozen=True, slots=True)
class Failed:
    """The stage cannot do its work and ends: why, and whether what the user gave is to blame."""

    why: str
    by_input: bool = False


@dataclass(frozen=True, slots=True)
class Finished:
    """All results are given."""

    times: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    device: str = ""
