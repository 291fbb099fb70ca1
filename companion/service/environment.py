"""Python environment of the service: the present one, or one made for it."""

from __future__ import annotations

import json
import shutil
import stat
import subprocess
import sys
from pathlib import Path

from companion import __version__
from companion.errors import InputError
from companion.service.shipped import clone
from companion.service.steps import Step, command

HIDDEN = (Path("/home"), Path("/root"), Path("/run/user"))
"""Folders hidden by ProtectHome= of the unit."""
MARK = "made-by-companion-install"
PYTHON = Path("/usr/bin/python3")
OLDEST, FIRST_TOO_NEW = (3, 10), (3, 14)


def present_environment() -> Path:
    """Environment of the running program."""
    return Path(sys.prefix)


def why_unfit(environment: Path) -> str:
    """Reason why a service of another user cannot run from it; "" where it can."""
    program = environment / "bin/companion"
    if not program.is_file():
        return f"{program} is not there"
    for path in (program, Path(sys.executable).resolve(), Path(sys.base_prefix).resolve()):
        if any(folder == path or folder in path.parents for folder in HIDDEN):
            return f"{path} is hidden from services"
        for part in (path, *path.parents):
            if not part.stat().st_mode & (stat.S_IXOTH if part.is_dir() else stat.S_IROTH):
                return f"{part} can be read by its owner only"
    return ""


def environment_made(folder: Path, unit_user: str) -> list[Step]:
    """Steps that make an environment in a folder from this clone; InputError if impossible."""
    source = clone()
    if source is None:
        raise InputError(
            f"this installation of companion cannot be used by {unit_user} and is no clone to "
            f"install from; python3 -m venv {folder}, install companion there, and run "
            f"{folder}/bin/companion install"
        )
    if folder.exists() and not (folder / MARK).exists() and any(folder.iterdir()):
        raise InputError(f"{folder}: is there already and not of ours; --venv names another place")
    _check_python()

    def make() -> None:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / MARK).write_text(f"{source}\n", "utf-8")
        command(PYTHON, "-m", "venv", folder)

    def fill() -> None:
        command(
            folder / "bin/python", "-m", "pip", "install", "--quiet",
            "--disable-pip-version-check", "--force-reinstall" if _version(folder) else "--upgrade",
            source,
        )  # fmt: skip

    return [
        Step(
            f"environment {folder}", lambda: (folder / "bin/python").exists(), make,
            lambda: shutil.rmtree(folder, ignore_errors=True),
        ),
        Step(
            f"companion {__version__} in {folder}, from {source}",
            lambda: _version(folder) == __version__, fill,
        ),
    ]  # fmt: skip


def _check_python() -> None:
    try:
        said = subprocess.run(
            [PYTHON, "-c", "import sys, json, ensurepip; print(json.dumps(sys.version_info[:2]))"],
            capture_output=True, text=True, check=False, timeout=60,
        )  # fmt: skip
    except FileNotFoundError:
        raise InputError(f"{PYTHON} is missing: apt install python3 python3-venv") from None
    if said.returncode:
        raise InputError(f"{PYTHON} cannot make an environment: apt install python3-venv")
    version = tuple(json.loads(said.stdout))
    if not OLDEST <= version < FIRST_TOO_NEW:
        raise InputError(f"{PYTHON} is {version[0]}.{version[1]}; wanted is 3.10 to 3.13")


def _version(folder: Path) -> str:
    """Version of companion installed in an environment; "" without one."""
    found = sorted(folder.glob("lib/python3*/site-packages/companion-*.dist-info"))
    return found[0].name.split("-")[1].removesuffix(".dist") if found else ""
