"""Cloud snapshots in flight: in slices, whole or not at all."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Pose
from companion.messages import MapUpdate, PointChunk
from companion.products.flight_result import FlightResult
from companion.runtime.stage_protocol import Snapshot, TakeSnapshot
from companion.stages.cloud_snapshots import BUSY, NO_POINTS, CloudSnapshots
from tests.support.reference.scoring import read_ply

N_CHUNKS, N_POINTS = 30, 400


def flown(rng: np.random.Generator) -> FlightResult:
    result = FlightResult()
    poses = {n: Pose(np.eye(3), np.array([float(n), 0.0, 0.0])) for n in range(N_CHUNKS)}
    result.take(MapUpdate(1, 1, poses, np.zeros((0, 3)), None))
    for n in range(N_CHUNKS):
        points = rng.uniform((-5, -5, 5), (5, 5, 9), (N_POINTS, 3)).astype(np.float32)
        none = np.zeros(N_POINTS, np.float32)
        result.take(PointChunk(
            n, n, points, np.zeros((N_POINTS, 3), np.uint8), none + 1, np.zeros_like(points), none
        ))  # fmt: skip
    return result


def until_over(snapshots: CloudSnapshots) -> list[Snapshot]:
    told: list[Snapshot] = []
    for _ in range(1000):
        told += snapshots.step()
        if told and (told[-1].path or told[-1].why_not):
            return told
    raise AssertionError("it never ends")


def test_it_is_the_cloud_that_the_flight_would_leave(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    result = flown(rng)
    snapshots = CloudSnapshots(tmp_path, result, 0.1)
    snapshots.begin(TakeSnapshot(7, GeoOrigin(1.0, 2.0, 3.0)))
    told = until_over(snapshots)
    last = told[-1]
    assert Path(last.path) == tmp_path / "snapshot-007.ply"
    assert [each.percent for each in told] == sorted({each.percent for each in told})
    assert last.n_points == len(read_ply(Path(last.path))) == len(result.cloud(0.1))
    assert last.n_points > 1000
    assert [path.name for path in tmp_path.iterdir()] == ["snapshot-007.ply"]
    assert snapshots.step() == []


def test_one_at_a_time(tmp_path: Path, rng: np.random.Generator) -> None:
    snapshots = CloudSnapshots(tmp_path, flown(rng), 0.1)
    snapshots.begin(TakeSnapshot(1))
    snapshots.begin(TakeSnapshot(2))
    told = until_over(snapshots)
    assert told[0] == Snapshot(2, why_not=BUSY)
    if told[-1].number != 1:
        told = until_over(snapshots)
    assert told[-1].number == 1 and told[-1].path


def test_why_there_is_none(tmp_path: Path, rng: np.random.Generator) -> None:
    empty = CloudSnapshots(tmp_path, FlightResult(), 0.1)
    empty.begin(TakeSnapshot(1))
    assert until_over(empty)[-1].why_not == NO_POINTS
    nowhere = CloudSnapshots(tmp_path / "gone", flown(rng), 0.1)
    nowhere.begin(TakeSnapshot(1))
    assert "gone" in until_over(nowhere)[-1].why_not
    nowhere.begin(TakeSnapshot(2))  # and another may be tried
    assert "gone" in until_over(nowhere)[-1].why_not
