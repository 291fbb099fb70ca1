"""Checks that all dependencies can be installed on a 64-bit ARM computer.

    python -m tests.bench.arm_wheels [--uv PROGRAM] [--python 3.10 …] [--extras survey …]

For each Python and set of extras, PyPI is asked for wheels only, none of which is downloaded, as an
aarch64 Linux would: the oldest glibc is named for which there are all. The exit status is 1 where
something is missing. It needs uv (pip install uv) and PyPI.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PROJECT = Path(__file__).parents[2] / "pyproject.toml"
PYTHONS = ("3.10", "3.11", "3.12", "3.13")
GLIBCS = {
    "2_17": "any", "2_28": "Debian 10", "2_31": "Ubuntu 20.04, Debian 11, JetPack 5",
    "2_35": "Ubuntu 22.04, JetPack 6", "2_36": "Debian 12, Raspberry Pi OS 12",
    "2_39": "Ubuntu 24.04, JetPack 7",
}  # fmt: skip
"""By what has it, the oldest first."""
LIMIT_S = 300


def main() -> int:
    """Ask for each; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--uv", default=shutil.which("uv") or "uv")
    parser.add_argument("--python", nargs="+", default=PYTHONS)
    parser.add_argument("--extras", nargs="*")
    arguments = parser.parse_args()
    known = tomllib.loads(PROJECT.read_text("utf-8"))["project"]["optional-dependencies"]
    extras = ["", *(known if arguments.extras is None else arguments.extras)]
    missing = 0
    for python in arguments.python:
        for extra in extras:
            glibc, said = oldest_glibc(arguments.uv, python, extra)
            name = f"companion[{extra}]" if extra else "companion"
            print(f"Python {python}, {name}: ", end="")
            if glibc:
                print(f"{said} packages, glibc from {glibc.replace('_', '.')} ({GLIBCS[glibc]})")
            else:
                print(f"not: {said}")
            sys.stdout.flush()
            missing += not glibc
    return 1 if missing else 0


def oldest_glibc(uv: str, python: str, extra: str) -> tuple[str, str]:
    """The oldest for which there are wheels of all, and of how many; or "", and why not."""
    why = ""
    for glibc in GLIBCS:
        command = [
            uv, "pip", "compile", "--quiet", "--no-header", "--no-annotate", "--no-config",
            "--only-binary", ":all:", "--python-version", python,
            "--python-platform", f"aarch64-manylinux_{glibc}", str(PROJECT),
        ]  # fmt: skip
        done = subprocess.run(
            [*command, *(["--extra", extra] if extra else [])],
            capture_output=True, text=True, timeout=LIMIT_S, check=False,
        )  # fmt: skip
        if done.returncode == 0:
            return glibc, str(len(done.stdout.split()))
        why = " ".join(done.stderr.split())
    return "", why


if __name__ == "__main__":
    sys.exit(main())
