"""The results stage writes the cloud, or all results, in mid-flight, and goes on."""

from __future__ import annotations

import queue
from pathlib import Path
from typing import Any

import numpy as np

from companion.config import Config
from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose
from companion.messages import MapUpdate, PointChunk
from companion.runtime.parcel import Parcel
from companion.runtime.stage_process import StageProcess
from companion.runtime.stage_protocol import (
    Finish,
    ResultsWritten,
    Setup,
    Snapshot,
    TakeSnapshot,
    WriteResults,
)
from companion.runtime.stage_start import start_alone
from companion.runtime.stages import stage_named
from companion.telemetry import AttitudeSample
from tests.support.flights.flown import facts
from tests.support.reference.scoring import read_ply

CAMERA = Camera(64, 48, 50.0, 50.0, 32.0, 24.0)
N_CHUNKS, N_POINTS = 200, 2000
PATIENCE_S = 300.0


def test_a_snapshot_and_another(tmp_path: Path, rng: np.random.Generator) -> None:
    told: queue.Queue[Any] = queue.Queue()
    stage = StageProcess(
        stage_named("results"), start_alone, lambda parcel: told.put(parcel.open()),
        lambda why: told.put(why),
    )  # fmt: skip
    stage.order(TakeSnapshot(0))  # before it knows what to do: passed over
    stage.begin(Setup(Config(), CAMERA, tmp_path))
    try:
        poses = {n: Pose(np.eye(3), np.array([3.0 * n, 0, 0])) for n in range(N_CHUNKS)}
        update = MapUpdate(1, 1, poses, np.zeros((0, 3)), None)
        stage.offer(Parcel.of(update))
        for n in range(N_CHUNKS):
            points = rng.uniform((-5, -5, 5), (5, 5, 9), (N_POINTS, 3)).astype(np.float32)
            ones = np.ones(N_POINTS, np.float32)
            colours = np.zeros((N_POINTS, 3), np.uint8)
            chunk = PointChunk(n, n, points, colours, ones, 0 * points, ones)
            stage.offer(Parcel.of(chunk))
        still = AttitudeSample(1, np.array([1.0, 0, 0, 0]))  # nothing is drawn anew for it
        for number in (1, 2):
            stage.order(TakeSnapshot(number))
            last = Snapshot(number)
            percents = []
            while not last.path:
                stage.offer(Parcel.of(still))  # the flight goes on: it is between its messages
                try:
                    last = told.get(timeout=0.02)
                except queue.Empty:
                    continue
                assert isinstance(last, Snapshot) and last.number == number and not last.why_not
                percents.append(last.percent)
            assert percents == sorted(percents) and len(percents) > 2
            assert len(read_ply(tmp_path / f"snapshot-{number:03d}.ply")) == last.n_points > 1000
        for written in (True, False, True):
            blocked = tmp_path / "report.json"
            blocked.unlink(missing_ok=True)
            if not written:
                blocked.mkdir()
            stage.order(WriteResults(facts()))
            so_far = told.get(timeout=PATIENCE_S)
            assert isinstance(so_far, ResultsWritten) and bool(so_far.why_not) != written
            assert (tmp_path / "report.html").exists()
            if not written:
                blocked.rmdir()
        stage.ask_to_finish(Finish(hurry=True))
        assert stage.wait(PATIENCE_S)
        assert stage.has_finished
    finally:
        stage.kill()
