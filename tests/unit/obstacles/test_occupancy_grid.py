"""Cells around a vehicle: what was seen through is free, what was measured is taken, and fades."""

from __future__ import annotations

import numpy as np
import pytest

from companion.geometry.transforms import Array, Similarity, rotation_from_vector
from companion.obstacles.occupancy_grid import (
    CELL_M,
    CLEAR_M,
    DOUBT,
    FADES_NS,
    FREE,
    LEAST,
    MOST,
    SHAPE,
    OccupancyGrid,
)

EYE = np.array([1000.1, -700.1, -30.1])
HERE = np.zeros((2, 3))


def begun(place: Array = EYE) -> OccupancyGrid:
    grid = OccupancyGrid()
    grid.move(place, 0)
    return grid


def level(grid: OccupancyGrid, place: Array) -> int:
    return int(grid.about(place, HERE)[0][0, 0, 0])


def north(away_m: float) -> Array:
    return EYE + [away_m, 0.0, 0.0]


def test_a_ray_frees_what_it_goes_through_and_nothing_else() -> None:
    grid = begun()
    grid.see_through(EYE, np.array([north(5.0), EYE + [0.0, 40.0, 0.0]]))
    assert level(grid, north(4.5)) == FREE and level(grid, north(5.3)) == 0
    assert level(grid, EYE + [0.0, CLEAR_M - 0.5, 0]) == FREE
    assert level(grid, EYE + [0.0, CLEAR_M + 0.5, 0]) == 0
    assert (grid._levels != 0).sum() == pytest.approx((5.0 + CLEAR_M) / CELL_M, abs=3)


def test_rays_in_all_directions_go_where_they_should() -> None:
    rng = np.random.default_rng(1)
    rays = rng.normal(size=(50, 3)) * [1, 1, 0.05]
    ends = EYE + 10.0 * rays / np.linalg.norm(rays, axis=1)[:, None]
    grid = begun()
    grid.see_through(EYE, ends)
    middles = (np.stack(np.nonzero(grid._levels), 1) - grid._first) % SHAPE + grid._first + 0.5
    away = middles * CELL_M - EYE
    along = np.clip(away @ (ends - EYE).T / 100.0, 0.0, 1.0)
    off = np.linalg.norm(away[:, None] - along[..., None] * (ends - EYE), axis=2)
    assert off.min(1).max() <= np.sqrt(0.75) * CELL_M  # a ray goes through each
    shares = np.linspace(0.0, 0.97, 50)
    on_the_way = [EYE + share * (end - EYE) for end in ends[:20] for share in shares]
    assert np.mean([level(grid, at) == FREE for at in on_the_way]) > 0.65


def test_free_fades_to_unknown_in_seconds_and_an_obstacle_in_more() -> None:
    grid = begun()
    for _ in range(20):
        grid.see_through(EYE, north(5.0)[None])
    grid.hit(north(6.0)[None])
    assert level(grid, north(3.0)) == LEAST and len(grid.occupied()) == 1
    grid.move(EYE, FADES_NS * (FREE - LEAST))
    assert level(grid, north(3.0)) == FREE
    grid.move(EYE, FADES_NS * (FREE - LEAST + 1))
    assert level(grid, north(3.0)) > FREE
    grid.move(EYE, FADES_NS * (MOST - DOUBT - 1))
    np.testing.assert_allclose(grid.occupied(), north(6.0)[None], atol=CELL_M)
    grid.move(EYE, FADES_NS * (MOST - DOUBT))
    assert len(grid.occupied()) == 0


def test_what_has_gone_is_seen_through_by_images_and_not_by_one() -> None:
    grid = begun()
    grid.hit(north(4.0)[None])
    grid.see_through(EYE, north(9.0)[None])
    assert len(grid.occupied()) == 1
    for _ in range(20):
        grid.see_through(EYE, north(9.0)[None])
    assert len(grid.occupied()) == 0 and level(grid, north(4.0)) == LEAST


def test_doubt_is_no_obstacle_and_not_free() -> None:
    grid = begun()
    grid.see_through(EYE, north(5.0)[None])
    grid.doubt(north(3.0)[None])
    assert level(grid, north(3.0)) == DOUBT and len(grid.occupied()) == 0
    grid.hit(north(3.0)[None])
    grid.doubt(north(3.0)[None])
    assert len(grid.occupied()) == 1


@pytest.mark.parametrize("away", [[25.0, 0, 0], [0, -70.0, 0], [0, 0, 9.0], [1e7, -1e7, 1e5]])
def test_what_is_left_behind_is_forgotten(away: list[float]) -> None:
    """The buffer is as large as ever, and holds nothing of it when the vehicle comes back."""
    grid = begun()
    before = grid._levels.nbytes
    grid.hit(EYE[None])
    grid.move(EYE + away, 0)
    assert len(grid.occupied()) == 0
    grid.hit(EYE[None])  # too far away
    grid.move(EYE, 0)
    assert len(grid.occupied()) == 0 and grid._levels.nbytes == before < 2e6


def test_what_stays_in_reach_is_where_it_was() -> None:
    grid = begun()
    grid.hit(north(10.0)[None])
    for step in np.arange(0.0, 8.0, 0.7):
        grid.move(EYE + [step, -0.5 * step, 0.2 * step], 0)
    np.testing.assert_allclose(grid.occupied(), north(10.0)[None], atol=CELL_M)


def test_cells_move_with_the_map_and_not_where_it_turns_or_stretches() -> None:
    grid = begun()
    grid.hit(north(6.0)[None])
    shift = np.array([0.4, 2.0, -1.0])
    assert grid.correct(EYE, Similarity(1.0, np.eye(3), shift))
    grid.move(EYE + shift, 0)
    np.testing.assert_allclose(grid.occupied(), north(6.0)[None] + shift, atol=CELL_M)
    assert not grid.correct(EYE, Similarity(1.1, np.eye(3), np.zeros(3)))
    turned = rotation_from_vector(np.array([0.0, 0.0, 0.1]))
    assert not grid.correct(EYE, Similarity(1.0, turned, np.zeros(3)))
