from __future__ import annotations

from copy import deepcopy
from functools import partial

import numpy as np
import pytest

from companion.geometry.voxel import voxel_downsample
from companion.products import gathered_cloud, voxel_cloud
from companion.products.cloud import Cloud, joined, no_cloud
from companion.products.gathered_cloud import gathered


def some_cloud(n: int, seed: int) -> Cloud:
    rng = np.random.default_rng(seed)
    points = rng.uniform([-200, -10, 0], [200, 10, 1], (n, 3)).astype(np.float32)
    number = np.arange(n, dtype=np.float32) + 10_000 * seed
    return Cloud(
        points, rng.integers(0, 255, (n, 3), np.uint8), rng.integers(0, 4, n).astype(np.float32),
        points + np.float32(1), number,
    )  # fmt: skip


def made_of(clouds: list[Cloud], voxel: float) -> tuple[Cloud, list[float]]:
    """What is gathered of them, and what it said of how far it was."""
    gathering = gathered([partial(deepcopy, c) for c in clouds], sum(map(len, clouds)), voxel)
    shares = []
    while True:
        try:
            shares.append(next(gathering))
        except StopIteration as over:
            return over.value, shares


@pytest.mark.parametrize("at_once", [1_000_000, 3000], ids=["one round", "many rounds"])
@pytest.mark.parametrize("least", [10, 100_000], ids=["while it grows", "at the end"])
def test_thinned_in_parts_is_as_thinned_at_once(
    least: int, at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(voxel_cloud, "LEAST_WAITING", least)
    monkeypatch.setattr(gathered_cloud, "AT_ONCE", at_once)
    clouds = [some_cloud(4000, seed) for seed in range(5)]
    found, shares = made_of(clouds, 0.7)
    assert shares == sorted(shares) and shares[-1] == 1.0
    whole = joined(clouds)
    low = clouds[0].points.astype(np.float64).min(0)
    kept = voxel_downsample(whole.points, whole.confidence, 0.7, low)
    order = np.argsort(found.sigma)
    assert len(found) < 0.9 * len(whole)
    assert np.array_equal(found.sigma[order], whole.sigma[kept])
    assert np.array_equal(found.points[order], whole.points[kept])
    assert np.array_equal(found.normals[order], whole.normals[kept])
    assert np.array_equal(found.rgb[order], whole.rgb[kept])


def test_nothing_gives_nothing() -> None:
    assert len(made_of([], 0.1)[0]) == 0
    assert len(made_of([no_cloud(), no_cloud()], 0.1)[0]) == 0


def test_rounds_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    clouds = [some_cloud(4000, seed) for seed in range(5)]
    once = made_of(clouds, 0.7)[0]
    monkeypatch.setattr(gathered_cloud, "AT_ONCE", 2500)
    again = made_of(clouds, 0.7)[0]
    for name in ("points", "rgb", "confidence", "normals", "sigma"):
        assert getattr(once, name).tobytes() == getattr(again, name).tobytes()
