"""Time alignment by rotation: the sample's video without its list of times."""

from __future__ import annotations

import hashlib
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.telemetry import video_alignment
from drivers.telemetry.telemetry_log import Pictures
from tests.support.processes.program import refused, replay_here
from tests.support.reference.scoring import read_tum

SAMPLE = Path(__file__).parents[2] / "sample" / "survey"
SPARSE = ["--set", "depth.enabled=false"]
FAST, FASTER = ["--stop", "14", *SPARSE], ["--stop", "5", *SPARSE]


@pytest.fixture(autouse=True, scope="module")
def turns_of_a_video_are_seen_once() -> Iterator[None]:
    """They do not depend on the log: four seconds of a processor for all pictures of the sample."""
    seen: dict[tuple[str, str], Any] = {}
    see = video_alignment._from_images

    def see_once(camera: Any, frames: Any, pictures: Pictures) -> Any:
        video = pictures.path if pictures.path.is_file() else pictures.path / "camera.mp4"
        key = repr(camera), hashlib.sha256(video.read_bytes()).hexdigest()
        if key not in seen:
            seen[key] = see(camera, frames, pictures)
        return seen[key]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(video_alignment, "_from_images", see_once)
        yield


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("camera.mp4", "camera.json", "telemetry.tlog"):
        shutil.copy(SAMPLE / name, tmp_path / name)
    return tmp_path


def true_offset_s() -> float:
    """The video's own times begin at zero."""
    return -float((SAMPLE / "frames.csv").read_text().splitlines()[1].split(",")[1]) * 1e-9


def test_aligned_by_rotation_and_said(folder: Path) -> None:
    run = replay_here(folder, folder / "out", *FAST)
    assert run.status == 0, run.stderr
    said = re.search(r"by rotation of the pictures: ([-+][\d.]+) s, within (\d+) ms", run.stdout)
    assert said is not None
    assert float(said[1]) == pytest.approx(true_offset_s(), abs=0.05)
    assert run.report["unit"] == "m"
    assert run.report["clock"]["method"] == "rotation of the pictures"
    found = read_tum(folder / "out" / "trajectory.tum")
    truth = read_tum(SAMPLE / "truth" / "world_from_camera.tum")
    assert len(found.t_s) > 130
    at = np.abs(found.t_s[:, None] - (truth.t_s - truth.t_s[0])).argmin(1)
    apart_m = np.linalg.norm(found.centres - truth.centres[at], axis=1)
    assert apart_m.max() < 0.7, "placed by telemetry at its own time"


def test_rotation_that_is_not_believed_aligns_nothing(folder: Path) -> None:
    only = ["--set", 'telemetry.use=["position", "range"]']
    line = refused(replay_here(folder, folder / "out", *FASTER, *only))
    assert "telemetry.tlog has neither rates nor attitude that telemetry.use lets count" in line


def test_offset_that_is_given(folder: Path) -> None:
    run = replay_here(folder, folder / "out", *FASTER, f"--offset={true_offset_s():.3f}")
    assert run.status == 0, run.stderr
    assert "rotation" not in run.stdout
    assert run.report["unit"] == "m"


def test_log_of_another_flight_is_refused(folder: Path) -> None:
    """The first ten seconds of the log say too little of the last thirty of the video."""
    log = (folder / "telemetry.tlog").read_bytes()
    (folder / "telemetry.tlog").write_bytes(log[: len(log) // 5])
    line = refused(replay_here(folder, folder / "out", *FAST))
    assert "--offset" in line
    assert "telemetry.tlog" in line


def test_log_elsewhere(folder: Path) -> None:
    (folder / "elsewhere").mkdir()
    (folder / "telemetry.tlog").rename(folder / "elsewhere" / "a.tlog")
    (folder / "camera.mp4").rename(folder / "flown.mp4")
    (folder / "camera.json").rename(folder / "flown.json")
    log = folder / "elsewhere" / "a.tlog"
    run = replay_here(folder / "flown.mp4", folder / "out", *FASTER, "--log", str(log))
    assert run.status == 0, run.stderr
    assert "a.tlog put on the time of flown.mp4" in run.stdout
    assert "no telemetry log" in refused(
        replay_here(
            folder / "flown.mp4", folder / "out", *FAST, "--log", str(folder / "flown.json")
        )
    )
