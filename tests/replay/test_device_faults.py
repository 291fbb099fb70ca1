"""An OpenCL device that fails while a flight is replayed costs the dense map at most."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.dense.device_takeover import FAILED_OVER, NO_DEVICE_LEFT
from tests.support.processes.program import Run, replay
from tests.support.reference.failing_driver import fail, two_devices

FLIGHT = Path(__file__).parents[2] / "sample" / "survey"
SHORT = "--stop", "6", "--set", "expert.depth.stride=8"
KERNELS = 900
"""The test at the start runs some hundred, each depth map some ten: it fails in mid-flight."""


def told(run: Run) -> dict[str, str]:
    """What was warned of, with the detail."""
    return {each["what"]: each["first_detail"] for each in run.report["warnings"]}


def test_the_next_device_takes_over_and_each_run_is_the_same(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    first, second = two_devices(monkeypatch, tmp_path)
    fail(monkeypatch, tmp_path, "lost", first, after=KERNELS)
    runs = [replay(FLIGHT, tmp_path / name, *SHORT) for name in ("a", "b")]
    for run in runs:
        assert run.status == 0, run.stderr
        assert told(run)[FAILED_OVER].startswith(f"{second.named}; {first.named}: fails")
        assert run.report["device"].startswith(second.named)
        assert f"failed: {first.named}" in run.report["device"]
        assert f"failed: {first.named}" in run.stdout
    for name in ("trajectory.tum", "cloud.ply"):
        a, b = ((run.out / name).read_bytes() for run in runs)
        assert a == b != b"", name


def test_without_another_device_path_and_report_are_whole(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    first, _ = two_devices(monkeypatch, tmp_path)
    fail(monkeypatch, tmp_path, "lost", first, after=KERNELS)
    asked_for = f"opencl.device={first.number}"  # so that no other may take over
    run = replay(FLIGHT, tmp_path / "a", *SHORT, "--set", asked_for)
    assert run.status == 0, run.stderr
    assert told(run)[NO_DEVICE_LEFT].startswith(f"{first.named}: fails while it computes")
    assert run.report["device"].startswith("none is left; failed: ")
    assert "dense map: none is left" in run.stdout
    n_placed = len((run.out / "trajectory.tum").read_text().splitlines())
    assert n_placed > 40
    assert (run.out / "report.html").exists()
