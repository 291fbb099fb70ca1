"""Settings in force while armed, kept in a file for a restart in the air.

The file exists from arming to disarming. Without it a crash would undo what the pilot has switched
off or made stricter, and would bring limits into force that were loosened in the configuration
meanwhile.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from companion.config import Config
from companion.config.setting_keys import value_of_key, with_values
from companion.config_file import current_key, with_value
from companion.daemon.control.tightening import WHILE_ARMED, tightened
from companion.errors import ConfigError

FILE = ".armed.json"
"""Name in the folder of flights, the one place that the daemon can certainly write to."""
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
"""Random id of each boot of the computer (random(4))."""
ANOTHER_BOOT = "unknown"
"""Boot id unknown: held changes are applied as soon as the autopilot reports disarmed."""
NOT_KEPT = "settings cannot be kept"
MODE = "feedback.mode"


@dataclass(frozen=True, slots=True)
class ArmedSettings:
    """Content of the file; times are CLOCK_MONOTONIC of the boot that it names."""

    values: Mapping[str, Any]
    """Value of each key of `WHILE_ARMED`."""
    by_ground: Mapping[str, Any]
    """Values set by the ground, by key."""
    computer_boot: str
    autopilot_boot_s: float | None
    """Boot time of the autopilot; None while unknown."""
    written_s: float


@dataclass(frozen=True, slots=True)
class Resumed:
    """Configuration of a daemon that starts in the air, and changes held until disarming."""

    config: Config
    waiting: dict[str, Any]
    by_ground: dict[str, Any]


def settings_of(
    config: Config, by_ground: Mapping[str, Any], autopilot_boot_s: float | None, now_s: float
) -> ArmedSettings:
    """Settings to keep while armed."""
    return ArmedSettings(
        {name: value_of_key(config, name) for name in WHILE_ARMED},
        {name: value for name, value in by_ground.items() if name in WHILE_ARMED},
        computer_boot(), autopilot_boot_s, now_s,
    )  # fmt: skip


def resumed(read: Config, before: ArmedSettings) -> Resumed:
    """A configuration just read, restricted to what may change in the air.

    Settings from the ground override it, and limits may only be tighter than before.
    """
    by_ground = dict(before.by_ground)
    running, wanted = with_values(read, before.values), with_values(read, by_ground)
    config, waiting = tightened(running, wanted)
    if by_ground.get(MODE) == "off" and read.feedback.mode != "off":
        waiting[MODE] = read.feedback.mode
    return Resumed(config, waiting, by_ground)


def encoded(settings: ArmedSettings) -> bytes:
    """Content of the file."""
    return json.dumps(asdict(settings)).encode()


def computer_boot() -> str:
    """Boot id of the computer; "" where unknown."""
    try:
        return BOOT_ID.read_text("ascii").strip()
    except OSError:
        return ""


def read_settings(flights: Path, config: Config) -> tuple[ArmedSettings | None, str]:
    """Settings left by the daemon before, None if it ended disarmed; and what is wrong with them.

    An unreadable file means that something was switched off or made stricter just as the computer
    lost its power: nothing is sent then as long as the motors are armed.
    """
    path = flights / FILE
    try:
        document = json.loads(path.read_bytes())
        checked = {
            name: value_of_key(with_value(config, name, value, FILE), name)
            for name, value in _current(document["values"]).items()
            if name in WHILE_ARMED
        }
        told = _current(document["by_ground"])
        by_ground = {name: checked[name] for name in told if name in checked}
        boot_s = document["autopilot_boot_s"]
        return ArmedSettings(
            checked, by_ground, str(document["computer_boot"]),
            None if boot_s is None else float(boot_s), float(document["written_s"]),
        ), ""  # fmt: skip
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        return None, ""  # nor can there have been one of ours
    except (OSError, ValueError, KeyError, TypeError, AttributeError, ConfigError) as error:
        off = {MODE: "off"}
        return ArmedSettings(off, off, ANOTHER_BOOT, None, 0.0), f"{path}: {error}"


def _current(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values by the keys of this version: an update may have come since they were written."""
    return {current_key(name): value for name, value in values.items()}
