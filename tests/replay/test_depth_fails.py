"""A dense map that fails takes nothing with it: path, report and the cloud so far are written."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from companion.runtime.in_order import DEPTH_FAILED
from tests.support.processes.program import Run
from tests.support.reference.scoring import read_ply, read_tum

SAMPLE = Path(__file__).parents[2] / "sample" / "survey"
FAILS = """
import sys
from companion.app.cli import main
from companion.dense.depth_stage import DepthStage
from companion.messages import DepthMap
flawed, n_left = getattr(DepthStage, sys.argv[1]), int(sys.argv[2])
def fails(self, *message):
    global n_left
    if n_left <= 0:
        raise MemoryError("no room for another depth map")
    out = flawed(self, *message)
    n_left -= sum(isinstance(each, DepthMap) for each in out)
    return out
setattr(DepthStage, sys.argv[1], fails)
sys.exit(main(sys.argv[3:]))
"""


@pytest.mark.parametrize(("where", "n_before"), [("step", 3), ("flush", 0)])
def test_what_was_finished_is_written(tmp_path: Path, where: str, n_before: int) -> None:
    command = [sys.executable, "-c", FAILS, where, str(n_before), "replay", str(SAMPLE)]
    out = tmp_path / "out"
    done = subprocess.run(
        [*command, "--out", str(out), "--stop", "6", "--set", "expert.depth.stride=8"],
        capture_output=True, text=True, timeout=200, check=False,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    *trace, said = done.stderr.splitlines()
    assert said.startswith("companion: error: the dense map failed after ")
    assert "MemoryError: no room for another depth map" in said
    assert str(out) in said
    assert trace[0].startswith("Traceback"), "a bug is to be found"
    report = Run(done.returncode, done.stdout, done.stderr, out).report
    (warning,) = [w for w in report["warnings"] if w["what"] == DEPTH_FAILED]
    assert warning["count"] == 1
    assert report["completed"]
    assert report["frames"] == 60, "frames are tracked to the end without it"
    assert len(read_tum(out / "trajectory.tum").t_s) >= 0.9 * 60
    assert report["depth_maps"] >= max(n_before, 1)
    assert (report["depth_maps"] == n_before) is (where == "step")
    if where == "flush":
        assert len(read_ply(out / "cloud.ply")) > 1000
    assert (out / "report.html").exists()
