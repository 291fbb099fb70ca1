"""Selection of the OpenCL device, and the cache of test results."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from companion.app.devices_command import opencl_lines
from companion.compute.compute_devices import (
    _known,
    _measured,
    choose_devices,
    unwritable_cache,
)
from companion.compute.device_probe import listed_devices, probed
from companion.compute.device_verdict import (
    circumstances,
    keep_verdict,
    kept_verdict,
    processor,
    verdict_path,
)
from companion.config import OpenclConfig
from companion.dense.device_choice import MeasuredDevice, in_order, why_taken
from companion.dense.opencl import ACCELERATOR, GPU, PROCESSOR, ListedDevice
from companion.errors import DeviceError
from tests.support.reference import opencl_devices
from tests.support.reference.failing_driver import fail, two_devices

DEVICE = ListedDevice("0:0", "a device", "a platform")
CHOOSE = """
import json, sys
from companion.compute.compute_devices import choose_devices, unwritable_cache
from companion.config import OpenclConfig
from companion.errors import DeviceError
import companion.compute.device_probe
companion.compute.device_probe.PATIENCE_S = float(sys.argv[2])
said = []
try:
    devices = choose_devices(OpenclConfig(sys.argv[1]), said.append)
    print(json.dumps([devices.current.name, devices.current.why, said]))
except DeviceError as error:
    print(json.dumps(["", str(error), said]))
"""
LONG_S = 120.0


def chosen(asked: str = "auto", patience_s: float = LONG_S) -> tuple[str, str, list[str]]:
    """Name of the device chosen by a new process, or ""; why; and its output."""
    done = subprocess.run(
        [sys.executable, "-c", CHOOSE, asked, str(patience_s)], capture_output=True, check=True
    )
    name, why, said = json.loads(done.stdout.splitlines()[-1])
    return name, why, said


# -- the order -----------------------------------------------------------------------------------


def at(number: str, speed: float | None, kind: str = PROCESSOR, name: str = "") -> MeasuredDevice:
    problem = "" if speed else "is wrong"
    return MeasuredDevice(number, name or number, "P", kind, "1", speed, problem)


@pytest.mark.parametrize(
    ("devices", "order"),
    [
        ([at("0:0", 50), at("0:1", 100)], ["0:1", "0:0"]),
        # 100 is no more than 1.2 times 84: the GPU leaves the processor to the pose
        ([at("0:0", 100), at("1:0", 84, GPU)], ["1:0", "0:0"]),
        ([at("0:0", 100), at("1:0", 83, GPU)], ["0:0", "1:0"]),
        ([at("0:0", 100), at("1:0", 99, ACCELERATOR), at("2:0", 90, GPU)], ["2:0", "1:0", "0:0"]),
        # by name: a number may be another after the next start
        ([at("0:0", 100, name="b"), at("1:0", 95, name="a")], ["1:0", "0:0"]),
        ([at("1:0", 100, name="b"), at("0:0", 105, name="a")], ["0:0", "1:0"]),
        # each within 20 % of the next: what is left is looked at again
        ([at("0:0", 70), at("0:1", 84), at("0:2", 100)], ["0:1", "0:2", "0:0"]),
        ([at("0:0", None), at("0:1", 1)], ["0:1"]),
        ([at("0:0", None)], []),
    ],
)  # fmt: skip
def test_fastest_first_and_fixed_order_between_equals(
    devices: list[MeasuredDevice], order: list[str]
) -> None:
    assert [each.number for each in in_order(devices)] == order
    assert [each.number for each in in_order(devices[::-1])] == order


def test_choice_is_explained() -> None:
    slow, fast, gpu, bad = at("0:0", 50), at("0:1", 100), at("1:0", 90, GPU), at("2:0", None)
    assert why_taken(fast, [fast]) == "the only one"
    assert why_taken(fast, [slow, fast]) == "the fastest of 2: 100 frames/s; 0:0 50"
    assert why_taken(fast, [bad, fast]).startswith("the only one of 2 that works")
    assert why_taken(gpu, [gpu, fast]).startswith("first in the fixed order of those within 20 %")
    assert "2:0 is wrong" in why_taken(fast, [bad, fast])


# -- devices that fail ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "problem", "patience_s"),
    [
        ("build", "kernels do not build for this processor", LONG_S),
        ("wrong", "self-test failed: ", LONG_S),
        ("lost", "fails while it computes", LONG_S),
        ("abort", "its driver ends the program (SIGABRT)", LONG_S),
        ("hang", "hangs for 5 s", 5.0),
    ],
)
def test_failing_device_is_rejected_and_the_next_one_chosen(
    fault: str, problem: str, patience_s: float, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bad, good = two_devices(monkeypatch, tmp_path, known=(False, True))
    fail(monkeypatch, tmp_path, fault, bad)
    name, why, said = chosen(patience_s=patience_s)
    assert name == good.named
    (line,) = said
    assert line.startswith(f"OpenCL: {bad.named}: {problem}") and len(line.splitlines()) == 1
    assert problem in why
    # it is known from now on
    name, _, said = chosen(patience_s=0.01)
    assert (name, said) == (good.named, [])


def test_configured_device_is_never_replaced(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bad, _ = two_devices(monkeypatch, tmp_path)
    fail(monkeypatch, tmp_path, "lost", bad)
    name, why, _ = chosen(bad.number)  # what is kept says that it works
    assert not name and why.startswith(f"{bad.named}: fails while it computes")


def test_no_device_at_all(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("OCL_ICD_VENDORS", str(tmp_path / "nothing"))
    name, why, _ = chosen()
    assert not name and "sudo apt install pocl-opencl-icd" in why
    asked = [sys.executable, "-m", "companion", "devices", "--opencl"]
    run = subprocess.run(asked, capture_output=True, text=True)
    assert run.returncode == 1
    assert "none" in run.stdout and "sudo apt install pocl-opencl-icd" in run.stderr


def test_exit_status_tells_whether_a_device_works(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bad, good = two_devices(monkeypatch, tmp_path)
    fail(monkeypatch, tmp_path, "build", bad)
    asked = [sys.executable, "-m", "companion", "devices", "--opencl"]
    run = subprocess.run([*asked, "--json"], capture_output=True, text=True)
    assert run.returncode == 0
    document = json.loads(run.stdout)
    (found,) = [each for each in document["opencl_devices"] if each["name"] == bad.name]
    assert found["problem"] == "kernels do not build for this processor"
    assert "BUILD_PROGRAM_FAILURE" in found["detail"]
    assert document["opencl_auto"]["number"] not in (bad.number, None)
    assert good.name in {each["name"] for each in document["opencl_devices"]}


def test_compiler_log_is_shown_on_request() -> None:
    bad = dataclasses.replace(at("0:0", None), problem="kernels do not build", detail="a\nb\nc")
    told = [line.strip() for line in opencl_lines([bad, at("1:0", 40)], verbose=False)]
    assert told[1:] == [
        "0:0  0:0 (P): kernels do not build", "1:0  1:0 (P): 40 frames/s of 640 x 480",
        "auto takes 1:0: the only one of 2 that works",
    ]  # fmt: skip
    told = [line.strip() for line in opencl_lines([bad], verbose=True)]
    assert told[2:] == ["1", "a", "b", "c", "auto takes none of them"]


def test_a_driver_is_not_blamed_for_a_processor_that_is_busy() -> None:
    """All share one, of which the driver's program gets a quarter, or some per cent.

    Each in a session of its own, as the driver's is: where the kernel shares a processor among
    sessions, and not among programs, nice values say nothing.
    """
    processor, right = min(os.sched_getaffinity(0)), at("0:0", 40)
    answer = json.dumps(dataclasses.asdict(right))
    keeps_busy = f"import os; os.sched_setaffinity(0, {{{processor}}}); print(flush=True)\n"
    command = [sys.executable, "-c", keeps_busy + "while True: pass"]
    with ExitStack() as stack:
        for _ in range(3):
            busy = subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True)
            stack.enter_context(busy)
            stack.callback(busy.kill)
            assert busy.stdout is not None
            busy.stdout.readline()
        program = (
            f"import os, time; os.sched_setaffinity(0, {{{processor}}}); os.nice(12)\n"
            "while time.process_time() < 0.15: pass\n"
            f"print({answer!r})"
        )
        began_s = time.monotonic()
        found = probed(right.listed, (sys.executable, "-c", program), 0.3)
        took_s = time.monotonic() - began_s
    assert took_s > 0.3
    assert found.problem == ""


@pytest.mark.parametrize(
    ("program", "problem", "patience_s"),
    [
        ("import os; os.abort()", "its driver ends the program (SIGABRT)", 60.0),
        ("import sys; sys.exit('why')", "its driver ends the program (status 1): why", 60.0),
        ("import time; time.sleep(60)", "hangs for 1 s", 1.0),
        ("print('[1]'); print('{\"number\": 1}'); print('{')", "its driver ends the program", 60.0),
    ],
)
def test_driver_that_ends_its_process_is_reported(
    program: str, problem: str, patience_s: float
) -> None:
    found = probed(DEVICE, (sys.executable, "-c", program), patience_s)
    assert (found.name, found.frames_per_s) == ("a device", None)
    assert found.problem.startswith(problem)


LISTS = """
import json, os, sys
first = int(sys.argv[2])
print("a driver greets")
for number in range(first, 3):
    print(json.dumps({"asked": number, "name": f"platform {number}"}), flush=True)
    if number == 1:
        os.abort()
    each = {"number": f"{number}:0", "name": "d", "platform": f"platform {number}"}
    print(json.dumps({"devices": [each]}), flush=True)
print(json.dumps({"finished": True}))
"""


def test_driver_that_ends_the_listing_hides_no_other() -> None:
    devices, failed = listed_devices((sys.executable, "-c", LISTS))
    assert [each.number for each in devices] == ["0:0", "2:0"]
    (bad,) = failed
    assert (bad.platform, bad.frames_per_s) == ("platform 1", None)
    assert bad.problem.startswith("its driver ends the program (SIGABRT)")
    devices, failed = listed_devices((sys.executable, "-c", "import time; time.sleep(60)"), 1.0)
    assert not devices and failed[0].problem == "hangs for 1 s"


# -- what is kept --------------------------------------------------------------------------------

ANSWERS = """
import json, pathlib, sys
listed, log = json.loads(sys.argv[1]), pathlib.Path(sys.argv[2])
if sys.argv[3] == "list":
    print(json.dumps({"asked": 0, "name": "P"}))
    print(json.dumps({"devices": [listed]}))
    print(json.dumps({"finished": True}))
else:
    log.write_text(log.read_text() + "measured\\n")
    print(json.dumps({**listed, "frames_per_s": 33.0}))
"""


TWO = """
import json, os, sys
if sys.argv[1] == "list":
    each = {"number": "0:0", "name": "first", "platform": "P"}
    print(json.dumps({"devices": [each, {**each, "number": "0:1", "name": "second"}]}))
    print(json.dumps({"finished": True}))
else:
    os.abort()
"""


class Measuring:
    """Measures the device of this computer as a selection does, by a program that counts calls.

    The device itself is not opened, of which what is kept says nothing.
    """

    def __init__(self, folder: Path) -> None:
        best = next(
            each for each in opencl_devices.known() if each.number == opencl_devices.working()[0]
        )
        self._log = folder / "measured.txt"
        self._log.write_text("")
        self.said: list[str] = []
        listed = json.dumps(dataclasses.asdict(best.listed))
        self._program = (sys.executable, "-c", ANSWERS, listed, str(self._log))

    def n(self) -> int:
        """Measurements during a selection now."""
        before = len(self._log.read_text())
        listed, _ = listed_devices(self._program)
        found = _measured(listed, _known(listed, listed), listed, self.said.append, self._program)
        assert in_order(found)
        return (len(self._log.read_text()) - before) // len("measured\n")


@pytest.fixture
def measuring(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Measuring:
    opencl_devices.known()
    monkeypatch.setenv("CACHE_DIRECTORY", str(tmp_path / "cache"))
    return Measuring(tmp_path)


def change(key: str) -> Callable[[dict[str, Any]], object]:
    return lambda document: document["circumstances"].update({key: ["another"]})


@pytest.mark.parametrize(
    "changed", [change(key) for key in ("devices", "processor", "linkers", "kernels", "companion")]
)
def test_cache_is_valid_until_something_changes(
    changed: Callable[[dict[str, Any]], object], measuring: Measuring
) -> None:
    assert [measuring.n() for _ in range(3)] == [1, 0, 0]
    path = verdict_path()
    assert path is not None
    document = json.loads(path.read_text())
    changed(document)
    path.write_text(json.dumps(document))
    assert [measuring.n() for _ in range(2)] == [1, 0]
    assert [each.name for each in path.parent.iterdir()] == [path.name]  # nothing half written
    assert not measuring.said


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: "",
        lambda text: "[]",
        lambda text: "[" * 100_000,
        lambda text: text.replace("33.0", '"fast"'),
        lambda text: text.replace("33.0", "-1"),
        lambda text: text.replace('"measured": [', '"measured": [{},'),
        lambda text: text.replace('"frames_per_s"', '"speed"'),
        lambda text: text.replace('"problem": ""', '"problem": 3'),
    ],
)
def test_corrupt_cache_is_ignored(damage: Callable[[str], str], measuring: Measuring) -> None:
    assert measuring.n() == 1
    path = verdict_path()
    assert path is not None
    text = path.read_text()
    assert damage(text) != text
    path.write_text(damage(text))
    assert [measuring.n() for _ in range(2)] == [1, 0]


def test_binary_cache_is_ignored(measuring: Measuring) -> None:
    assert measuring.n() == 1
    path = verdict_path()
    assert path is not None
    path.write_bytes(b"\xff\x00\xfe" * 100)
    assert [measuring.n() for _ in range(2)] == [1, 0]


def test_unwritable_cache_is_reported(measuring: Measuring, tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("a file where a folder is wanted")  # root writes anywhere else
    assert [measuring.n() for _ in range(2)] == [1, 1]
    assert len(measuring.said) == 2  # once for each start
    assert all("measured at each start" in line for line in measuring.said)


def test_cache_path() -> None:
    assert verdict_path({"HOME": "/h"}) == Path("/h/.cache/companion/opencl.json")
    assert verdict_path({"HOME": "/h", "XDG_CACHE_HOME": "/c"}) == Path("/c/companion/opencl.json")
    service = {"CACHE_DIRECTORY": "/var/cache/companion", "XDG_CACHE_HOME": "/c"}
    assert verdict_path(service) == Path("/var/cache/companion/opencl.json")
    assert verdict_path({}) is None


def test_another_driver_of_the_same_device_is_another_device(tmp_path: Path) -> None:
    old = at("0:0", 40)
    new = dataclasses.replace(old, driver="2")
    path = tmp_path / "verdict.json"
    keep_verdict(path, circumstances([old]), [old])
    assert kept_verdict(path, circumstances([old])) == {old.identity: old}
    assert kept_verdict(path, circumstances([new])) == {}
    assert kept_verdict(path, circumstances([old, at("0:1", 40)])) == {}


def test_processor_identity_excludes_its_clock(tmp_path: Path) -> None:
    path = tmp_path / "cpuinfo"
    path.write_text("processor\t: 0\nmodel name\t: A\ncpu MHz\t: 800\nprocessor\t: 1\n")
    one = processor(path)
    path.write_text("processor\t: 0\nmodel name\t: A\ncpu MHz\t: 3000\n")
    assert processor(path) == one
    path.write_text("processor\t: 0\nmodel name\t: B\ncpu MHz\t: 800\n")
    assert processor(path) != one


def test_results_before_an_interruption_are_cached(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A service that exceeds its start timeout would otherwise never get further."""
    monkeypatch.setenv("CACHE_DIRECTORY", str(tmp_path))

    def stop(remark: str) -> None:
        if "second" in remark:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        choose_devices(OpenclConfig(), stop, program=(sys.executable, "-c", TWO))
    path = verdict_path()
    assert path is not None
    document = json.loads(path.read_text())
    assert [each["name"] for each in document["measured"]] == ["first"]


def test_devices_failed_in_flight_are_excluded() -> None:
    (number, *_) = opencl_devices.working()
    best = next(each for each in opencl_devices.known() if each.number == number)
    devices = choose_devices(OpenclConfig(number), failed={best.identity: "it: was lost"})
    assert devices.current is None
    assert devices.described == "none is left; failed: it: was lost"
    with pytest.raises(DeviceError, match="none of"):
        choose_devices(OpenclConfig("no-such-device"))


def test_a_folder_that_pocl_cannot_write_is_named(tmp_path: Path) -> None:
    """It has no device then, as where it is not installed."""
    assert unwritable_cache({"HOME": str(tmp_path)}) == unwritable_cache({}) == ""
    for name in ("HOME", "XDG_CACHE_HOME", "POCL_CACHE_DIR"):
        told = unwritable_cache({"HOME": str(tmp_path), name: "/proc/nowhere"})
        assert "/proc/nowhere" in told and "POCL_CACHE_DIR" in told
