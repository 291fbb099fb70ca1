"""Cache of OpenCL device tests on disk.

Valid while nothing relevant has changed: drivers and versions, the set of devices, the processor,
linkers of PoCL, our kernels and version.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import platform
import tempfile
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from companion import __version__
from companion.dense.device_choice import MeasuredDevice
from companion.dense.opencl import ListedDevice, linkers

FILE = "opencl.json"
CPUINFO = Path("/proc/cpuinfo")
CPU_FIELDS = (
    "vendor_id", "cpu family", "model", "model name", "stepping",  # x86
    "CPU implementer", "CPU architecture", "CPU variant", "CPU part", "CPU revision",  # ARM
)  # fmt: skip
TESTED = (".cl", "self_test.py", "self_test.npz")
"""Files of companion.dense on which results depend."""


def verdict_path(environment: Mapping[str, str] = os.environ) -> Path | None:
    """Path of the cache, of the service or the user; None for a user without a home."""
    own = environment.get("CACHE_DIRECTORY", "").partition(":")[0]  # systemd.exec(5)
    if own:
        return Path(own, FILE)
    caches, home = environment.get("XDG_CACHE_HOME", ""), environment.get("HOME", "")
    if not caches and not home:
        return None
    return Path(caches or Path(home, ".cache"), "companion", FILE)


def circumstances(listed: Sequence[ListedDevice]) -> dict[str, Any]:
    """Everything that results depend on."""
    return {
        "devices": sorted(each.identity for each in listed),
        "processor": processor(),
        "linkers": linkers(),
        "kernels": _kernels(),
        "companion": __version__,
    }


def processor(path: Path = CPUINFO) -> list[str]:
    """Identification of the processor; each kind of core once."""
    try:
        lines = path.read_text(errors="replace").splitlines()
    except OSError:
        return [platform.machine()]
    fields = (line.partition(":") for line in lines)
    kept = {f"{name.strip()}: {value.strip()}" for name, _, value in fields
            if name.strip() in CPU_FIELDS}  # fmt: skip
    return [platform.machine(), *sorted(kept)]


def _kernels() -> str:
    room = resources.files("companion.dense")
    files = [*room.iterdir(), *(room / "kernels").iterdir()]
    digest = hashlib.sha256()
    for file in sorted(files, key=lambda each: each.name):
        if file.name.endswith(TESTED):
            digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()


def kept_verdict(path: Path | None, now: Mapping[str, Any]) -> dict[str, MeasuredDevice]:
    """Cached results by identity under these circumstances; {} without any.

    A corrupt file counts as none.
    """
    if path is None:
        return {}
    try:
        document = json.loads(path.read_bytes())
        if document["circumstances"] != dict(now):
            return {}
        found = [_checked(each) for each in document["measured"]]
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return {}
    return {each.identity: each for each in found}


def _checked(fields: Mapping[str, Any]) -> MeasuredDevice:
    speed = fields["frames_per_s"]
    texts = [value for name, value in fields.items() if name != "frames_per_s"]
    if not all(isinstance(text, str) for text in texts):
        raise TypeError("texts are wanted")
    if speed is not None and not (isinstance(speed, (int, float)) and 0 < speed < 1e9):
        raise ValueError(f"{speed} frames/s")
    return MeasuredDevice(**fields)


def keep_verdict(path: Path, now: Mapping[str, Any], measured: Sequence[MeasuredDevice]) -> None:
    """Replace the cache atomically; OSError on failure."""
    document = {
        "circumstances": dict(now),
        "measured": [dataclasses.asdict(each) for each in measured],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    # unique name: several processes may measure concurrently
    number, part = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
    try:
        with open(number, "w", encoding="utf-8") as file:
            json.dump(document, file, indent=1)
        os.replace(part, path)
    except BaseException:
        Path(part).unlink(missing_ok=True)
        raise
