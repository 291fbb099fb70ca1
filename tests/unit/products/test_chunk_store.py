from __future__ import annotations

import os
from dataclasses import fields
from pathlib import Path

import numpy as np

from companion.messages import PointChunk
from companion.products.chunk_store import POINT, ChunkStore
from companion.products.flight_result import GIVEN_UP, FlightResult
from tests.support.flights import flown

N = 500
MB = N * POINT.itemsize / 1e6


def same(a: PointChunk, b: PointChunk) -> bool:
    return all(np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(PointChunk))


def test_old_chunks_go_to_disk_and_come_back_as_they_were(tmp_path: Path) -> None:
    store = ChunkStore(tmp_path, 3 * MB)
    for k in (3, 1, 2, 0, 7, 5, 4, 6):
        store.put(flown.chunk(k, N))
    assert store.n_points == 8 * N
    assert store._n_held == 3 * N
    assert store.keyframe_ids == list(range(8))
    for k in range(8):
        assert same(store.get(k), flown.chunk(k, N))
    store.close()


def test_a_chunk_that_comes_again_replaces_one_on_disk(tmp_path: Path) -> None:
    store = ChunkStore(tmp_path, MB)
    for k in range(4):
        store.put(flown.chunk(k, N))
    store.put(flown.chunk(1, 100))
    assert store.n_points == 3 * N + 100
    assert same(store.get(1), flown.chunk(1, 100))
    store.close()


def test_nothing_is_left_in_the_folder_even_without_an_end(tmp_path: Path) -> None:
    store = ChunkStore(tmp_path, MB)
    for k in range(4):
        store.put(flown.chunk(k, N))
    assert store._file is not None and os.fstat(store._file.fileno()).st_size >= 3 * N
    assert list(tmp_path.iterdir()) == []
    store.close()


def test_the_cloud_is_the_same_from_disk_as_from_memory(tmp_path: Path) -> None:
    alone, spilled = FlightResult(), FlightResult(tmp_path, 3 * MB)
    for message in flown.messages():
        alone.take(message)
        spilled.take(message)
    assert spilled._chunks._stored
    one, two = alone.cloud(0.5), spilled.cloud(0.5)
    for name in ("points", "rgb", "confidence", "normals", "sigma"):
        assert np.array_equal(getattr(one, name), getattr(two, name))
    spilled.close()
    assert len(spilled.cloud(0.5)) == 0


def test_points_that_the_disk_does_not_take_are_named(tmp_path: Path) -> None:
    result = FlightResult(tmp_path / "gone", MB)
    for k in range(4):
        result.take(flown.chunk(k, N))
    assert result.n_points == N
    assert result.warnings[GIVEN_UP].count == 3
