"""Smoothing of a cloud whose errors are alike in several points, as those of depth maps are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from companion.products.cloud import Cloud
from companion.products.export.smoothing import smoothed

SPACING_M, SIGMA_M = 0.065, 0.1
STEP_M = 1.5
"""The eastern half of the ground lies so much higher, as a roof does."""


@pytest.fixture
def ground(rng: np.random.Generator) -> Cloud:
    """Of 10 m by 10 m, seen from above."""
    side = np.arange(-5, 5, SPACING_M)
    north, east = (each.ravel() for each in np.meshgrid(side, side, indexing="ij"))
    alike = gaussian_filter(rng.normal(size=(len(side), len(side))), 2.0)
    down = SIGMA_M * alike.ravel() / alike.std() - STEP_M * (east > 0)
    n = len(down)
    return Cloud(
        np.stack([north, east, down], 1).astype(np.float32), np.zeros((n, 3), np.uint8),
        np.ones(n, np.float32), np.tile(np.array([0, 0, -1], np.float32), (n, 1)),
        np.full(n, SIGMA_M, np.float32),
    )  # fmt: skip


def off_m(cloud: Cloud) -> np.ndarray:
    """Below the true ground."""
    return cloud.points[:, 2] + STEP_M * (cloud.points[:, 1] > 0)


def test_errors_alike_in_several_points_are_averaged(ground: Cloud) -> None:
    after = off_m(smoothed(ground))
    assert np.sqrt(np.mean(after**2)) < 0.4 * np.sqrt(np.mean(off_m(ground) ** 2))


def test_a_step_stays_one(ground: Cloud) -> None:
    after = smoothed(ground)
    beside = np.abs(ground.points[:, 1]) < 0.3
    assert np.quantile(np.abs(off_m(after)[beside]), 0.95) < 2 * SIGMA_M
    np.testing.assert_array_equal(after.points[:, :2], ground.points[:, :2])  # along the normals


def test_without_standard_deviations_nothing_moves(ground: Cloud) -> None:
    cloud = replace(ground, sigma=np.full(len(ground), np.nan, np.float32))
    assert smoothed(cloud) is cloud
