from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.voxel import distinct_cells, voxel_downsample


def test_most_confident_point_per_voxel() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-10, 10, (5000, 3))
    confidence = rng.uniform(0, 1, 5000)
    kept = voxel_downsample(points, confidence, 1.5)
    cell = [tuple(c) for c in np.floor((points - points.min(0)) / 1.5).astype(int)]
    best: dict[tuple[int, ...], int] = {}
    for n, c in enumerate(cell):
        if c not in best or confidence[n] > confidence[best[c]]:
            best[c] = n
    assert kept.tolist() == sorted(best.values())


def test_ties_resolve_to_the_earlier_point() -> None:
    points = np.tile([[0.1, 0.2, 0.3], [5.0, 5.0, 5.0]], (10, 1))
    assert voxel_downsample(points, np.ones(20), 1.0).tolist() == [0, 1]


def test_downsampling_is_idempotent() -> None:
    points = np.random.default_rng(1).uniform(0, 3, (1000, 3))
    points[0] = 0  # the grid begins at the lowest corner, which must stay
    confidence = np.r_[2.0, np.random.default_rng(2).uniform(0, 1, 999)]
    once = voxel_downsample(points, confidence, 0.4)
    again = voxel_downsample(points[once], confidence[once], 0.4)
    assert again.tolist() == list(range(len(once)))


def test_voxel_size_limits() -> None:
    points = np.random.default_rng(3).uniform(0, 3, (200, 3))
    assert len(voxel_downsample(points, np.ones(200), 1e-4)) == 200
    assert len(voxel_downsample(points, np.ones(200), 100.0)) == 1
    assert len(voxel_downsample(points[:0], np.ones(0), 1.0)) == 0


@pytest.mark.parametrize("apart", [1, 2**40])
def test_distinct_cells_are_those_of_unique_rows(apart: int) -> None:
    """Far apart their numbers in the grid do not fit into an integer."""
    cells = np.random.default_rng(3).integers(-9, 10, (2000, 2)) * apart
    found, which = distinct_cells(cells)
    expected, index = np.unique(cells, axis=0, return_inverse=True)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(which, index.ravel())


@pytest.mark.parametrize("side", [1.0, 1e-15])
def test_best_of_each_voxel_is_kept_the_first_of_ties(side: float) -> None:
    generator = np.random.default_rng(1)
    points = generator.integers(0, 4, (400, 3)).astype(np.float64)
    confidence = generator.integers(0, 3, 400).astype(np.float32)
    points += side / 3
    kept: dict[tuple[float, ...], int] = {}
    for i, cell in enumerate(map(tuple, points.tolist())):
        if cell not in kept or confidence[i] > confidence[kept[cell]]:
            kept[cell] = i
    found = voxel_downsample(points, confidence, side, np.zeros(3))
    assert found.tolist() == sorted(kept.values())
