from __future__ import annotations

import numpy as np
import pytest

from companion.output import voxel_cloud
from companion.output.cloud import Cloud, joined
from companion.output.voxel_cloud import VoxelCloud
from companion.voxel import thin_by_voxel


def some_cloud(n: int, seed: int) -> Cloud:
    rng = np.random.default_rng(seed)
    points = rng.uniform([-200, -10, 0], [200, 10, 1], (n, 3)).astype(np.float32)
    number = np.arange(n, dtype=np.float32) + 10_000 * seed
    return Cloud(
        points, rng.integers(0, 255, (n, 3), np.uint8), rng.integers(0, 4, n).astype(np.float32),
        points + np.float32(1), number,
    )  # fmt: skip


@pytest.mark.parametrize("least", [10, 100_000], ids=["while it grows", "at the end"])
def test_thinned_in_parts_is_as_thinned_at_once(
    least: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(voxel_cloud, "LEAST_WAITING", least)
    clouds = [some_cloud(4000, seed) for seed in range(5)]
    grown = VoxelCloud(0.7)
    for cloud in clouds:
        grown.add(cloud)
    whole = joined(clouds)
    low = clouds[0].points.astype(np.float64).min(0)
    kept = thin_by_voxel(whole.points, whole.confidence, 0.7, low)
    found = grown.finish()
    order = np.argsort(found.sigma)
    assert len(found) < 0.9 * len(whole)
    assert np.array_equal(found.sigma[order], whole.sigma[kept])
    assert np.array_equal(found.points[order], whole.points[kept])
    assert np.array_equal(found.normals[order], whole.normals[kept])
    assert np.array_equal(found.rgb[order], whole.rgb[kept])


def test_nothing_gives_nothing() -> None:
    assert len(VoxelCloud(0.1).finish()) == 0
