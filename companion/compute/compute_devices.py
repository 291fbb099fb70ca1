"""Selection of OpenCL devices, with failover order.

All users of the dense engine select here. Devices are tested in separate processes (device_probe),
and results cached (device_verdict).
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from companion.compute.device_probe import PROGRAM, listed_devices, probed
from companion.compute.device_verdict import circumstances, keep_verdict, kept_verdict, verdict_path
from companion.config import OpenclConfig
from companion.dense.device_choice import MeasuredDevice, in_order, why_taken
from companion.dense.device_takeover import Devices, Watch, unsupervised
from companion.dense.opencl import WANT, ComputeDevice, ListedDevice, device_asked_for
from companion.errors import DeviceError

Say = Callable[[str], None]
"""Receives remarks on the selection for the user, a line each."""
NO_FAILURES: Mapping[str, str] = {}


def say_on_stderr(remark: str) -> None:
    """Print a line."""
    print(f"companion: {remark}", file=sys.stderr, flush=True)


def remeasured_devices() -> list[MeasuredDevice]:
    """All devices, tested and timed now, and failing platforms; results are cached."""
    listed, failed = listed_devices()
    return [*_measured(listed, {}, listed, say_on_stderr, report=False), *failed]


def choose_device(config: OpenclConfig, say: Say = say_on_stderr) -> ComputeDevice:
    """The first of `choose_devices`."""
    device = choose_devices(config, say).current
    assert device is not None
    return device


def choose_devices(
    config: OpenclConfig, say: Say = say_on_stderr, failed: Mapping[str, str] = NO_FAILURES,
    watch: Watch = unsupervised, program: Sequence[str] = PROGRAM,
) -> Devices:  # fmt: skip
    """The configured device, or all working ones, in order of preference.

    DeviceError without any, with the reason for each. `failed` are reasons, by identity, of
    failures in this flight: those are excluded, and then none may be left. `program` lists and
    measures.
    """
    listed, unlisted = listed_devices(program)
    if not listed:
        raise DeviceError(_none(unlisted))
    for each in unlisted:
        say(f"OpenCL: {each.named}: {each.problem}")
    asked_for = config.device != "auto"
    wanted = [device_asked_for(config.device, listed)] if asked_for else list(listed)
    wanted = [each for each in wanted if each.identity not in failed]
    # in flight rejected devices stay rejected
    known = _known(wanted if asked_for and not failed else listed, listed)
    found = [*_measured(wanted, known, listed, say, program), *([] if asked_for else unlisted)]
    order = in_order(found)
    if not order and not failed:
        raise DeviceError(_none(found))

    def why(taken: ListedDevice) -> str:
        if asked_for:
            return "asked for"
        return why_taken(taken, found) if taken is order[0] else "the next best"

    devices = Devices(order, why, list(failed.values()), watch)
    for failure in devices.failures[len(failed) :]:
        say(f"OpenCL: {failure}")
    return devices


def _none(found: Sequence[MeasuredDevice]) -> str:
    if not found:
        return f"no OpenCL device on this machine: {WANT}{unwritable_cache()}"
    refused = "; ".join(f"{each.named}: {each.problem}" for each in found)
    return f"no OpenCL device that works: {refused}: {WANT}"


def unwritable_cache(environment: Mapping[str, str] = os.environ) -> str:
    """Words for PoCL's folder of built kernels, without which it has no device; "" if it is well.

    Without a home it takes one of its own.
    """
    caches, home = environment.get("XDG_CACHE_HOME", ""), environment.get("HOME", "")
    folder = environment.get("POCL_CACHE_DIR", "") or caches or (home and f"{home}/.cache")
    try:
        if folder:
            os.makedirs(folder, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
    except OSError as error:
        why = f"cannot be written ({error.strerror}); POCL_CACHE_DIR names another"
        return f". PoCL needs a folder for what it builds: {folder} {why}"
    return ""


def _known(
    wanted: Sequence[ListedDevice], listed: Sequence[ListedDevice]
) -> dict[str, MeasuredDevice]:
    """Cached results; none where no wanted device works, since that may have been fixed."""
    kept = kept_verdict(verdict_path(), circumstances(listed))
    found = [kept[each.identity] for each in wanted if each.identity in kept]
    hopeless = len(found) == len(wanted) and not in_order(found)
    return {} if hopeless else kept


def _measured(
    wanted: Sequence[ListedDevice], known: dict[str, MeasuredDevice],
    listed: Sequence[ListedDevice], say: Say, program: Sequence[str] = PROGRAM,
    report: bool = True,
) -> list[MeasuredDevice]:  # fmt: skip
    """The wanted devices, each with its cached result or measured now.

    New results are cached at once: a service stopped for exceeding its start timeout continues
    there.
    """
    now, why_not = circumstances(listed), ""
    for each in wanted:
        if each.identity in known:
            continue
        found = known[each.identity] = probed(each, program)
        if found.problem and report:
            say(f"OpenCL: {found.named}: {found.problem}")
        why_not = _kept(verdict_path(), now, list(known.values()))
    if why_not:
        say(f"OpenCL: what devices can do is not kept, and measured at each start: {why_not}")
    return [known[each.identity] for each in wanted]


def _kept(path: Path | None, now: Mapping[str, Any], found: Sequence[MeasuredDevice]) -> str:
    """Cache results; "", or why that failed."""
    if path is None:
        return "neither $XDG_CACHE_HOME nor $HOME is set"
    try:
        keep_verdict(path, now, found)
    except OSError as error:
        return str(error)
    return ""
