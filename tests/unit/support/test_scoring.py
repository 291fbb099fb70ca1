"""Scoring functions of the tests."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.support.reference.scoring import Array, Trajectory, align, depth_errors, read_tum, score

SAMPLE = Path(__file__).parents[3] / "sample" / "survey"


def random_rotation(rng: np.random.Generator) -> Array:
    return np.asarray(Rotation.random(random_state=rng).as_matrix())


def test_alignment_undoes_a_similarity(rng: np.random.Generator) -> None:
    points = rng.normal(size=(40, 3))
    rotation, shift = random_rotation(rng), rng.normal(size=3)
    found = align(points, 2.5 * points @ rotation.T + shift)
    assert found.scale == pytest.approx(2.5)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(found.translation, shift, atol=1e-12)


def test_score_of_a_shrunken_turned_noisy_run(rng: np.random.Generator) -> None:
    truth = read_tum(SAMPLE / "truth" / "world_from_camera.tum")
    noise = rng.normal(scale=0.1, size=truth.centres.shape)
    turned = 0.9 * (truth.centres + noise) @ random_rotation(rng).T + 7
    half = slice(0, None, 2)
    run = Trajectory(truth.t_s[half] + 1e-4, turned[half], truth.rotations[half])
    result = score(run, truth)
    assert result.tracked_share == pytest.approx(0.5)
    assert result.scale_error == pytest.approx(0.1, abs=0.005)
    assert result.ate_sim3_m == pytest.approx(0.1 * np.sqrt(3), rel=0.1)


def test_depth_errors_of_points_seen_in_the_truth_itself() -> None:
    """Pixel, lens and pose conventions in one, undone by OpenCV's inverse of the lens."""
    truth = read_tum(SAMPLE / "truth" / "world_from_camera.tum")
    camera = json.loads((SAMPLE / "camera.json").read_text())
    lens = np.array([camera[name] for name in ("k1", "k2", "p1", "p2", "k3")])
    matrix = np.array(
        [[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1.0]]
    )
    image = cv2.imread(str(SAMPLE / "truth" / "depth" / "000097.png"), cv2.IMREAD_UNCHANGED)
    assert image is not None
    v, u = np.mgrid[5:475:10, 5:635:10]
    z = (image[v, u] * 0.005).reshape(-1, 1)
    pixels = np.stack([u, v], -1).reshape(-1, 1, 2).astype(np.float64)
    rays = np.c_[cv2.undistortPoints(pixels, matrix, lens)[:, 0], np.ones(len(z))]
    points = (z * rays) @ truth.rotations[97].T + truth.centres[97]
    assert np.median(depth_errors(points, SAMPLE, truth)) < 1e-3
    higher = np.median(depth_errors(points - [0, 0, 2], SAMPLE, truth))
    assert higher == pytest.approx(2 / np.median(z), rel=0.3)
