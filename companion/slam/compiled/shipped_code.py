"""Machine code of the compiled loops as a package carries it, and whether it fits here.

It is for any processor of its architecture, and for the versions that it was made with:
`made_for.json` beside it says which. Code of other loops, or for others than these, is not loaded.
"""

from __future__ import annotations

import hashlib
import json
import platform
import sys
from collections.abc import Mapping
from pathlib import Path

FOLDER = Path(__file__).parent / "code"
"""Folder of a package that has it; a clone, or what pip has installed, has none."""
MADE_FOR = "made_for.json"


def circumstances(numba: str, llvmlite: str) -> dict[str, str]:
    """All that code depends on, by name, for these versions of the compiler."""
    sources = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        sources.update(path.read_bytes())
    return {
        "numba": numba,
        "llvmlite": llvmlite,
        "Python": f"{sys.version_info.major}.{sys.version_info.minor}",
        "architecture": platform.machine(),
        "loops": sources.hexdigest()[:16],
    }


class ShippedCode:
    """Code in a folder, by the names of its loops; `why_unfit` is "" where it can be used."""

    def __init__(self, folder: Path, here: Mapping[str, str]) -> None:
        self._folder = folder
        self.why_unfit = ""
        try:
            made_for = json.loads((folder / MADE_FOR).read_text("utf-8"))
        except FileNotFoundError:
            self._is_there = False
            return
        except (OSError, ValueError) as error:
            made_for, self.why_unfit = {}, f"{folder / MADE_FOR}: {error}"
        self._is_there = not self.why_unfit
        for name, value in here.items() if self._is_there else ():
            if made_for.get(name) != value:
                self.why_unfit = f"it is for {name} {made_for.get(name)}, and here is {value}"
                break

    def of(self, loop: str) -> bytes | None:
        """Code of a loop, `module.name`; None where there is none that fits."""
        if not self._is_there or self.why_unfit:
            return None
        try:
            return (self._folder / f"{loop}.code").read_bytes()
        except OSError as error:
            self.why_unfit = f"{loop}: {error.strerror}"
            return None


def write(folder: Path, code: Mapping[str, bytes], here: Mapping[str, str]) -> None:
    """Write code by the names of its loops; `ShippedCode` reads it."""
    folder.mkdir(exist_ok=True)
    for name, data in code.items():
        (folder / f"{name}.code").write_bytes(data)
    (folder / MADE_FOR).write_text(json.dumps(dict(here), indent=2) + "\n", "utf-8")
