"""Listing and testing of OpenCL devices in separate processes: a driver may end its process.

As a program: `list FIRST` lists platforms from a number on and their devices, `measure NUMBER`
tests one device; output is JSON, one line each.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from companion.compute.device_verdict import verdict_path
from companion.compute.driver_files import VENDORS, driver_files, folder_with
from companion.dense.device_choice import MeasuredDevice, measured, measured_device
from companion.dense.opencl import ListedDevice, devices_of, platform_names
from companion.timing.clock import monotonic_s

PROGRAM = (sys.executable, "-m", "companion.compute.device_probe")
PATIENCE_S = 120.0
"""The first build of the kernels takes most of a minute on a small processor."""
LIST_PATIENCE_S = 30.0
TICK_S = 0.1
MAX_PLATFORMS = 32
UNKNOWN = "?:?"
"""Number of what has failed before the loader named a platform."""
NOTHING_ELSE: Mapping[str, str] = {}
MAX_LINE_CHARS = 160
PR_SET_PDEATHSIG = 1
"""Option of prctl(2): the signal at the death of the parent."""


def listed_devices(
    program: Sequence[str] = PROGRAM, patience_s: float = LIST_PATIENCE_S
) -> tuple[list[ListedDevice], list[MeasuredDevice]]:
    """All devices; and platforms whose driver fails on listing.

    Where the loader itself fails, each driver is tried by itself: those that it fails with are left
    out from now on, in this process and those that it starts, which must not have called the loader
    yet.
    """
    devices, failed = _listed(program, patience_s)
    if devices or not any(each.number == UNKNOWN for each in failed):
        return devices, failed
    left_out: list[MeasuredDevice] = []
    good: list[Path] = []
    for file in driver_files():
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / file.name).symlink_to(file.absolute())
            _, alone = _listed(program, patience_s, {VENDORS: folder})
        bad = [each for each in alone if each.number == UNKNOWN]
        left_out += [dataclasses.replace(each, platform=f"the driver of {file}") for each in bad]
        good += [] if bad else [file]
    if not left_out or not good:
        return [], left_out or failed
    cache = verdict_path()
    try:
        os.environ[VENDORS] = str(folder_with(good, None if cache is None else cache.parent))
    except OSError as error:
        return [], [dataclasses.replace(each, detail=str(error)) for each in left_out]
    devices, failed = _listed(program, patience_s)
    return devices, [*left_out, *failed]


def _listed(
    program: Sequence[str], patience_s: float, environment: Mapping[str, str] = NOTHING_ELSE
) -> tuple[list[ListedDevice], list[MeasuredDevice]]:
    devices: list[ListedDevice] = []
    failed: list[MeasuredDevice] = []
    first, before = 0, -1
    while before < first < MAX_PLATFORMS:
        before = first
        said, ended, detail = _said(["list", str(first)], program, patience_s, environment)
        asked = ListedDevice(UNKNOWN, "", "a driver, when platforms are listed")
        finished = False
        for line in said:
            if "asked" in line:
                asked = ListedDevice(f"{line['asked']}:?", "", str(line["name"]))
                first = int(line["asked"]) + 1
            devices += [ListedDevice(**each) for each in line.get("devices", [])]
            finished = finished or "finished" in line
        if finished:
            break
        failed.append(measured(asked, None, ended, detail))
    return devices, failed


def probed(
    listed: ListedDevice, program: Sequence[str] = PROGRAM, patience_s: float | None = None
) -> MeasuredDevice:
    """A device as measured by `program`, or how that failed."""
    said, ended, detail = _said(["measure", listed.number], program, patience_s or PATIENCE_S)
    for line in reversed(said):
        try:
            found = MeasuredDevice(**line)
        except TypeError:
            continue  # other output
        if found.identity == listed.identity:
            return found
    return measured(listed, None, ended, detail)


def _said(
    arguments: Sequence[str], program: Sequence[str], patience_s: float,
    environment: Mapping[str, str] = NOTHING_ELSE,
) -> tuple[list[dict[str, Any]], str, str]:  # fmt: skip
    """JSON output of the program; how it ended, in words; and its error output.

    `environment` is what differs from that of this process.
    """
    # Ctrl-C is handled by this process, which ends it
    with subprocess.Popen(
        [*program, *arguments], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, start_new_session=True, env={**os.environ, **environment},
    ) as process:  # fmt: skip
        began_s, left_s = monotonic_s(), patience_s
        while True:
            try:
                stdout, stderr = process.communicate(timeout=left_s)
                break
            except subprocess.TimeoutExpired as error:
                left_s = patience_s - (monotonic_s() - began_s) + _waited_s(process.pid)
                if left_s <= 0.0:
                    process.kill()
                    return (
                        _lines(error.stdout),
                        f"hangs for {patience_s:.0f} s",
                        _text(error.stderr),
                    )
                left_s = max(left_s, TICK_S)
    said = _text(stderr)
    problem = f"its driver ends the program ({_how(process.returncode)})"
    last = [line[:MAX_LINE_CHARS] for line in said.splitlines()[-1:]]
    return _lines(stdout), ": ".join([problem, *last]), said


def _waited_s(pid: int) -> float:
    """Time for which a thread of a process could run and had no processor, the longest of all.

    The dense map runs only where nothing else wants to, and its driver hangs for none of that. By
    `schedstat` of proc(5); 0 where the kernel does not say.
    """
    waited_ns = 0
    for path in Path(f"/proc/{pid}/task").glob("*/schedstat"):
        with contextlib.suppress(OSError, IndexError):
            waited_ns = max(waited_ns, int(path.read_text().split()[1]))
    return waited_ns * 1e-9


def _lines(stdout: bytes | None) -> list[dict[str, Any]]:
    """JSON objects of the output; other output of drivers is ignored."""
    out = []
    for line in (stdout or b"").splitlines():
        try:
            value = json.loads(line)
        except ValueError:
            continue
        if isinstance(value, dict):
            out.append(value)
    return out


def _text(stderr: bytes | None) -> str:
    return (stderr or b"").decode(errors="replace").strip()


def _how(status: int) -> str:
    if status >= 0:
        return f"status {status}"
    try:
        return signal.Signals(-status).name
    except ValueError:
        return f"signal {-status}"


def main() -> int:
    """List or measure; returns the exit status."""
    # a hanging driver must not outlive its caller
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, int(signal.SIGKILL))
    what, which = sys.argv[1:]
    if what == "list":
        for number, name in list(enumerate(platform_names()))[int(which) :]:
            _say({"asked": number, "name": name})
            _say({"devices": [dataclasses.asdict(each) for each in devices_of(number)]})
        _say({"finished": True})
        return 0
    (listed,) = [each for each in devices_of(int(which.partition(":")[0])) if each.number == which]
    _say(dataclasses.asdict(measured_device(listed, monotonic_s)))
    return 0


def _say(what: dict[str, Any]) -> None:
    print(json.dumps(what), flush=True)


if __name__ == "__main__":
    sys.exit(main())
