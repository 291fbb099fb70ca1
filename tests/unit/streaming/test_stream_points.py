from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

from companion.errors import StreamError
from companion.streaming.point_codec import coarse_of, decode_points, encode_points


def surface(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A bumpy wall some metres away, its colours by place, as a camera sees it."""
    random = np.random.default_rng(seed)
    flat = random.uniform([-4, -3], [4, 3], (n, 2))
    depth = 8 + np.sin(flat[:, 0]) + 0.02 * random.normal(size=n)
    rgb = np.clip(
        np.column_stack([100 + 20 * flat[:, 0], 90 + 10 * flat[:, 1], np.full(n, 60)])
        + random.normal(0, 4, (n, 3)), 0, 255,
    )  # fmt: skip
    points = np.column_stack([flat, depth]).astype(np.float32)
    return points, rgb.astype(np.uint8), random.uniform(0, 1, n).astype(np.float32)


@pytest.mark.parametrize("n", [1, 2, 3, 1000, 20_000])
def test_points_come_back_within_half_a_step(n: int) -> None:
    points, rgb, confidence = surface(n)
    step = float(np.median(np.linalg.norm(points, axis=1))) / 1024
    got, colours, sure = decode_points(encode_points(points, rgb, confidence))
    assert len(got) == n
    distance, nearest = KDTree(points).query(got)
    assert distance.max() <= 0.5 * step * np.sqrt(3) * 1.01
    if n <= 3:
        assert np.abs(colours.astype(int) - rgb[nearest]).max() <= 4
        assert np.abs(sure - confidence[nearest]).max() <= 0.5 / 7 + 1e-6
    assert np.abs(colours.mean(axis=0) - rgb.mean(axis=0)).max() < 4


def test_a_point_costs_less_than_six_bytes() -> None:
    points, rgb, confidence = surface(20_000)
    assert len(encode_points(points, rgb, confidence)) < 6 * 20_000


def test_far_points_get_a_larger_step_and_no_overflow() -> None:
    points = np.array([[0, 0, 1], [0, 0, 1.01], [1e7, -1e7, 1]], np.float32)
    black, unsure = np.zeros((3, 3), np.uint8), np.zeros(3, np.float32)
    got, _, _ = decode_points(encode_points(points, black, unsure))
    assert np.abs(np.sort(got[:, 0]) - np.sort(points[:, 0])).max() < 40


def test_what_is_not_finite_is_left_out_and_nothing_is_nothing() -> None:
    points, rgb, confidence = surface(3)
    points[1, 2] = np.nan
    assert len(decode_points(encode_points(points, rgb, confidence))[0]) == 2
    none = encode_points(points[:0], rgb[:0], confidence[:0])
    assert [len(part) for part in decode_points(none)] == [0, 0, 0]


@pytest.mark.parametrize("cut", [0, 10, 20, 21, 100, 2000])
def test_broken_points_are_refused(cut: int) -> None:
    whole = encode_points(*surface(1000))
    with pytest.raises(StreamError, match="cannot be decoded"):
        decode_points(whole[:cut])


def test_points_that_were_tampered_with_are_refused_or_finite() -> None:
    whole = bytearray(encode_points(*surface(300)))
    random = np.random.default_rng(5)
    for _ in range(300):
        bad = bytearray(whole)
        bad[random.integers(4, len(bad))] ^= int(random.integers(1, 256))
        try:
            points, rgb, _ = decode_points(bytes(bad))
        except StreamError:
            continue
        assert len(points) == len(rgb) == 300


def test_the_coarse_level_is_spread_and_bounded() -> None:
    points, _, _ = surface(20_000)
    chosen = coarse_of(points, 0.5, 10_000)
    cells = {tuple(cell) for cell in np.floor((points - points.min(0)) / 0.5).astype(int)}
    assert len(chosen) == len(cells)
    assert len(coarse_of(points, 0.01, 700)) == 700
    assert len(coarse_of(points[:0], 0.5, 10)) == 0
