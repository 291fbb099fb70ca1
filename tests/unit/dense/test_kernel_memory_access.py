"""Kernels in a simulator that checks memory accesses (Price & McIntosh-Smith 2015)."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.reference.dense_trial import SHUFFLED

SOURCES = Path(__file__).parents[3] / "companion" / "dense" / "kernels"
WATCH = ("--check-api", "--data-races", "--uninitialized", "--max-errors", "100000")
NOT_OURS = re.compile(r"Function: clGet(Device|Platform)Info\b")
"""pyopencl asks devices for what only some of them know."""
MISTAKEN = re.compile(rf"ninitialized (?:value|address).*\n\s*Kernel: ({'|'.join(SHUFFLED)})")
"""What these compute is held against numpy to the last bit elsewhere."""

pytestmark = pytest.mark.skipif(
    shutil.which("oclgrind") is None, reason="no oclgrind here (apt install oclgrind)"
)


def watched(log: Path, *command: str) -> tuple[str, list[str]]:
    """Output of a command under the simulator, and the faults of its kernels."""
    done = subprocess.run(
        ["oclgrind", *WATCH, "--log", str(log), sys.executable, *command],
        capture_output=True, text=True, check=False, timeout=280,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    found = [part for part in log.read_text().split("\n\n") if part.strip()]
    return done.stdout, [f for f in found if not NOT_OURS.search(f) and not MISTAKEN.search(f)]


@pytest.mark.parametrize(
    ("width", "height", "stride", "n_views"), [(64, 48, 2, 6), (41, 33, 1, 3), (69, 51, 2, 1)]
)
def test_kernels_access_memory_within_bounds(
    tmp_path: Path, width: int, height: int, stride: int, n_views: int
) -> None:
    size = map(str, (width, height, stride, n_views))
    ran, wrong = watched(tmp_path / "log", "-m", "tests.support.reference.dense_trial", *size)
    assert not wrong, f"{len(wrong)} faults, the first: {wrong[0]}"
    names = re.findall(r"__kernel void (\w+)", "".join(p.read_text() for p in SOURCES.glob("*.cl")))
    known = {"blocks_about": "blocks", "to_grid": "grey"}
    assert len(names) > 10
    for name in names:
        assert any(n.startswith(known.get(name, name)) for n in ran.split()), f"{name} was not run"


BAD = """
import numpy as np, pyopencl as cl
context = cl.create_some_context(interactive=False)
queue = cl.CommandQueue(context)
source = "__kernel void k(__global int *x) { const int i = get_global_id(0); %s }"
buffer = cl.Buffer(context, cl.mem_flags.READ_WRITE, 64)
cl.Kernel(cl.Program(context, source).build(), "k")(queue, (16,), (4,), buffer)
queue.finish()
"""


@pytest.mark.parametrize(
    ("body", "fault"),
    [
        ("x[i + 1] = i;", "Invalid write of size 4"),
        ("x[i / 8] = i;", "data race"),
        ("if (x[i] > 3) x[i] = 1;", "uninitialized"),
    ],
)
def test_memory_fault_is_detected(tmp_path: Path, body: str, fault: str) -> None:
    _, wrong = watched(tmp_path / "log", "-c", BAD % body)
    assert any(fault in w for w in wrong)
