"""Files shipped with the program: in its package, or beside it in a clone."""

from __future__ import annotations

from pathlib import Path

from companion.errors import InstallError
from companion.service.install_paths import OWN_ENVIRONMENT, SYSTEM

PACKAGED = Path(__file__).with_name("files")
CLONE = Path(__file__).parents[2]
PLACES_IN_CLONE = {"companion.toml": "config"}
UNIT_PROGRAM = str(OWN_ENVIRONMENT / "bin/companion")


def shipped(name: str) -> str:
    """Text of a unit, of the udev rules, or of the configuration."""
    for path in (PACKAGED / name, CLONE / PLACES_IN_CLONE.get(name, "systemd") / name):
        if path.is_file():
            return path.read_text("utf-8")
    raise InstallError(f"{name} did not come with this installation of companion; install it anew")


def clone() -> Path | None:
    """Folder of the clone that the program runs from; None for an installed package."""
    return CLONE if (CLONE / "pyproject.toml").is_file() else None


def unit_for(program: Path, user: bool) -> str:
    """The unit, with the path of the program."""
    text = shipped("companion-user.service" if user else "companion.service")
    changed = text.replace(f"ExecStart={UNIT_PROGRAM} ", f"ExecStart={program} ")
    assert f"ExecStart={program} " in changed and (user or str(SYSTEM.config) in changed)
    return changed
