"""Files by which the OpenCL loader finds drivers (cl_khr_icd), and how one of them is left out.

The loader initialises all drivers at its first call. One that ends the process there, or hangs,
hides all others; where it is not listed, they work.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

VENDORS = "OCL_ICD_VENDORS"
"""Names the folder that loaders search instead of /etc/OpenCL/vendors, or one file."""
FOLDER = Path("/etc/OpenCL/vendors")
SUFFIX = ".icd"


def driver_files(environment: Mapping[str, str] = os.environ) -> list[Path]:
    """The files that the loader reads, in the order of their names; none it cannot read."""
    where = Path(environment.get(VENDORS) or FOLDER)
    try:
        return sorted(each for each in where.iterdir() if each.suffix == SUFFIX)
    except OSError:
        return []


def folder_with(files: Sequence[Path], cache: Path | None) -> Path:
    """A folder with links to some of the files only, for `VENDORS`; OSError where none can be made.

    It lies in `cache` under a name that tells what is in it, so that processes may share it; else
    it is a temporary one.
    """
    names = "\0".join(str(each.absolute()) for each in files)
    name = "drivers-" + hashlib.sha256(names.encode()).hexdigest()[:12]
    try:
        if cache is None:
            raise FileNotFoundError
        folder = cache / name
        folder.mkdir(parents=True, exist_ok=True)
        _link(files, folder)
    except OSError:
        folder = Path(tempfile.mkdtemp(prefix="companion-drivers-"))
        _link(files, folder)
    return folder


def _link(files: Sequence[Path], folder: Path) -> None:
    for each in files:
        link = folder / each.name
        if not link.is_symlink():
            link.symlink_to(each.absolute())
