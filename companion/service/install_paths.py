"""Paths of a service's files: of the computer, or of one user."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from companion.errors import InputError

ACCOUNT = "companion"
GROUPS = ("video", "dialout", "render")
"""Groups of cameras, serial ports and GPUs."""
UNIT = "companion.service"
RULES = "99-companion.rules"
PACKAGED_UNITS = (Path("/usr/lib/systemd/system", UNIT), Path("/lib/systemd/system", UNIT))
OWN_ENVIRONMENT = Path("/opt/companion")


@dataclass(frozen=True, slots=True)
class Places:
    """Paths; `rules` is None where no udev rules can be set."""

    unit: Path
    config: Path
    rules: Path | None
    working: Path
    """Working directory, which relative paths refer to."""
    kept: tuple[Path, ...]
    """Removed by --purge only: configuration, flights, caches, logs."""
    systemctl: tuple[str, ...]
    manager: Path
    """Exists only while the service manager runs."""


SYSTEM = Places(
    unit=Path("/etc/systemd/system", UNIT),
    config=Path("/etc/companion/companion.toml"),
    rules=Path("/etc/udev/rules.d", RULES),
    working=Path("/var/lib", ACCOUNT),
    kept=tuple(Path(name, ACCOUNT) for name in ("/etc", "/var/lib", "/var/cache", "/var/log")),
    systemctl=("systemctl",),
    manager=Path("/run/systemd/system"),
)


def user_places(environment: Mapping[str, str] = os.environ) -> Places:
    """Paths for the user of this environment; InputError where it states no home."""
    home = environment.get("HOME", "")
    if not home:
        raise InputError("$HOME is not set; --user wants to know whose service it is to be")
    config, state = Path(home, ".config"), Path(home, ".local/state")
    return Places(
        unit=config / "systemd/user" / UNIT,
        config=config / ACCOUNT / "companion.toml",
        rules=None,
        working=state / ACCOUNT,
        kept=(config / ACCOUNT, state / ACCOUNT),
        systemctl=("systemctl", "--user"),
        manager=Path(environment.get("XDG_RUNTIME_DIR", "/nonexistent"), "systemd/private"),
    )
