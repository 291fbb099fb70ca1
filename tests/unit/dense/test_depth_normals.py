from __future__ import annotations

import numpy as np
import pytest

from companion.dense.normals import normals
from companion.geometry.transforms import Array
from companion.messages import Floats

K = (100.0, 110.0, 31.0, 22.0)


def depth_of_plane(normal: Array, distance: float) -> Floats:
    v, u = np.indices((48, 64), np.float64)
    rays = np.stack([(u - K[2]) / K[0], (v - K[3]) / K[1], np.ones(u.shape)], -1)
    return np.asarray(-distance / (rays @ normal), np.float32)


@pytest.mark.parametrize("way", [(0, 0, -1), (0.5, 0.1, -1), (-0.3, 0.8, -0.9), (0, -1.5, -1)])
def test_normals_of_a_plane(way: tuple[float, float, float]) -> None:
    normal = np.array(way) / np.linalg.norm(way)
    depth = depth_of_plane(normal, 3.0)
    depth[10:14, 20:30] = 0
    found = normals(depth, K)
    known = depth > 0
    assert np.abs(found[known] - normal).max() < 2e-3
    assert (found[~known] == 0).all()


def test_normals_do_not_mix_surfaces() -> None:
    depth = depth_of_plane(np.array([0, 0, -1.0]), 2.0)
    depth[:, 32:] *= 1.5
    assert np.abs(normals(depth, K) - [0, 0, -1]).max() < 1e-4


def test_isolated_pixel_has_no_normal() -> None:
    depth = np.zeros((48, 64), np.float32)
    depth[20, 20] = 2.0
    assert not normals(depth, K).any()


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (3, 70)])
def test_any_size(shape: tuple[int, int]) -> None:
    assert normals(np.ones(shape, np.float32), K).shape == (*shape, 3)
