"""Sectors that are free: nothing of a stated size can stand in them unseen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.geometry.camera import Camera
from companion.geometry.gimbal import Gimbal
from companion.geometry.transforms import Array, Pose, rotation_from_vector, yaw_rotation
from companion.obstacles.clear_sight import can_see_free, free_sectors
from companion.obstacles.newest_sight import Seen
from companion.obstacles.obstacle_sectors import FREE_M
from companion.obstacles.occupancy_grid import CELL_M, FADES_NS, MOST, OccupancyGrid
from companion.obstacles.sight_tracks import MOST_IMAGES
from tests.support.flights.approach_scene import ApproachScene, Sheet
from tests.unit.obstacles.test_newest_sight import AHEAD, SCENE, looked

Mask = NDArray[np.bool_]
EYE = np.array([3.0, -4.0, -10.0])
HERE = Pose(np.eye(3), EYE)
WINDOW_RAD = 9 / 500
NARROW = Camera(320, 290, 500.0, 500.0, 159.5, 144.5, body_from_camera=AHEAD)
"""Sees all heights that are asked for, and the sectors from -3 to 3."""


def corners(away_m: float = 30.0, sigma: float = 0.002, apart_deg: float = 1.0) -> Seen:
    """A level view to the north, 60 degrees wide, with a corner at each degree of a far surface."""
    east, up = np.meshgrid(np.arange(-30, 30, apart_deg), np.arange(-18, 19, apart_deg))
    east, up = np.radians(east.ravel()), np.radians(up.ravel())
    rays = np.stack([np.ones(east.shape), np.tan(east), -np.tan(up) / np.cos(east)], 1)
    inverse_m = np.full(len(rays), 1.0 / away_m)
    sigmas = np.full(len(rays), sigma)
    return Seen(0, EYE, rays, inverse_m, sigmas, inverse_m + 2 * sigmas)


def kept(seen: Seen, mask: Mask) -> Seen:
    return Seen(
        seen.t_ns, EYE, seen.rays_world[mask], seen.inverse_m[mask], seen.sigma[mask],
        seen.most_inverse_m[mask],
    )  # fmt: skip


def filled(grid: OccupancyGrid, seen: Seen) -> None:
    """What the finder does with an image."""
    grid.move(seen.eye_world_m, seen.t_ns)
    grid.see_through(seen.eye_world_m, seen.ends_world_m)
    grid.doubt(seen.points_world_m)


def flown(seen: Seen, way_m: float = 1.0) -> OccupancyGrid:
    """What is shown, by images on the way to `EYE`."""
    grid = OccupancyGrid()
    for back_m in np.linspace(way_m, 0.0, 9):
        filled(grid, replace(seen, eye_world_m=EYE - [back_m, 0.3 * back_m, 0.1 * back_m]))
    return grid


def free(seen: Seen, way_m: float = 1.0) -> set[int]:
    """Sectors that are in view as a whole, those to the left below zero."""
    found = np.flatnonzero(free_sectors(flown(seen, way_m), seen, HERE)[np.r_[:6, -5:0]])
    return {int(sector - 11 if sector > 5 else sector) for sector in found}


def angles_deg(seen: Seen) -> tuple[Array, Array]:
    """Bearing and elevation."""
    x, y, z = seen.rays_world.T
    return np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(-z, np.hypot(x, y)))


def test_a_far_surface_shows_that_what_is_before_it_is_free() -> None:
    assert free(corners()) == set(range(-5, 6))
    wall = corners(away_m=FREE_M + 1.0, sigma=0.001, apart_deg=0.4)
    assert free(wall, 0.0) == set(range(-5, 6))
    assert free(corners(away_m=FREE_M - 0.5)) == set()


def test_sectors_turn_with_the_vehicle() -> None:
    to_the_right = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    found = free_sectors(flown(corners()), corners(), Pose(to_the_right, EYE))
    assert set(np.flatnonzero(found)) >= set(range(72 - 18 - 5, 72 - 18 + 6))
    assert found.sum() <= 13


def test_without_parallax_nothing_is_free() -> None:
    """As over one spot: all looks as if it were far away, and might be near."""
    assert free(corners(away_m=1e6, sigma=0.07)) == set()


@pytest.mark.parametrize("at_deg", [(0.0, 0.0, 8.0), (11.0, 9.0, 6.0), (-14.5, -8.0, 5.0)])
def test_a_thing_without_corners_leaves_its_sectors_unknown(
    at_deg: tuple[float, float, float],
) -> None:
    """By its edges corners of what is behind are followed, half a window into it."""
    seen = corners(apart_deg=0.4)
    bearing, up = angles_deg(seen)
    half = np.degrees(CELL_M / at_deg[2])
    hidden = (np.abs(bearing - at_deg[0]) <= half) & (np.abs(up - at_deg[1]) <= half)
    about = round(at_deg[0] / 5)
    left = free(kept(seen, ~hidden), 0.0)
    assert about not in left
    assert left >= set(range(-5, 6)) - {about - 1, about, about + 1}


def test_too_few_corners_show_nothing() -> None:
    assert free(corners(apart_deg=4.0)) == set()


@pytest.mark.parametrize("away_m", [3.0, 8.4])
def test_a_corner_in_front_speaks_against_all_about_it(away_m: float) -> None:
    """What is measured just behind may be just in front."""
    seen = corners(apart_deg=0.4)
    bearing, up = angles_deg(seen)
    n = int(np.argmin((bearing - 13.0) ** 2 + (up - 2.0) ** 2))
    near = seen.inverse_m.copy()
    near[n] = 1.0 / away_m
    found = free(replace(seen, inverse_m=near, most_inverse_m=near + 0.01), 0.0)
    assert not found & {2, 3}
    assert found >= set(range(-5, 6)) - {1, 2, 3, 4}  # it is wider from near by


def test_ground_below_the_band_is_no_obstacle() -> None:
    """As seen from two metres: it is where it was measured, under what the vehicle flies through;
    from half a metre it is in its way."""
    seen = corners()
    _, up = angles_deg(seen)
    for height_m, wanted in ((2.0, set(range(-5, 6))), (0.5, set())):
        slope = np.tan(np.radians(-up)) * np.hypot(*seen.rays_world[:, :2].T)
        inverse_m = np.where(up < -1e-9, np.maximum(slope / height_m, 1 / 30), 1 / 30)
        found = free(replace(seen, inverse_m=inverse_m, most_inverse_m=inverse_m + 0.004))
        assert found == wanted


def test_what_was_seen_seconds_ago_is_not_free() -> None:
    """Nor what this image does not show any more."""
    seen = corners()
    grid = flown(seen)
    bearing, _ = angles_deg(seen)
    left = set(np.flatnonzero(free_sectors(grid, kept(seen, bearing > 3.0), HERE)))
    assert {1, 2, 3, 4, 5} <= left <= {1, 2, 3, 4, 5, 6}
    grid.move(EYE, MOST * FADES_NS)
    assert not free_sectors(grid, seen, HERE).any()


def found_by(
    path: Callable[[int], Array], scene: ApproachScene = SCENE, n_images: int = 12
) -> list[Mask]:
    """Which sectors are free, after each image of which something is known."""
    grid = OccupancyGrid()
    free: list[Mask] = []

    def take(seen: Seen) -> None:
        filled(grid, seen)
        free.append(free_sectors(grid, seen, Pose(np.eye(3), seen.eye_world_m)))

    looked(path, 0.02, NARROW, scene, take, n_images)
    return free


def test_a_far_wall_is_free_before_it_and_a_pole_is_not() -> None:
    found = found_by(lambda n: np.array([0.0, 0.05 * n - 0.55, -3.0]))[-1]
    assert found[[-2, -1]].all()
    assert not found[1] and not found[2]  # the pole, 15 cm thick to either side
    assert found.sum() <= 5


def test_one_that_stops_sees_nothing_free() -> None:
    """Though what is about it was free just now, and by its poses it moves by centimetres."""
    n_stopped = 8
    found = found_by(
        lambda n: np.array([0.0, 0.08 * min(n, n_stopped) - 0.88, -3.0]),
        n_images=n_stopped + MOST_IMAGES + 1,
    )
    assert any(each.any() for each in found[:n_stopped])
    assert not found[-1].any()


def test_open_country_is_free_below_the_sky_and_a_pole_before_it_is_not() -> None:
    hedge = Sheet(np.array([30.0, -40, -4]), np.array([0, 80.0, 0]), np.array([0, 0, 4.0]), 2)
    country = ApproachScene([*SCENE.things[:1], hedge, *SCENE.things[2:]], 0.06)
    found = found_by(lambda n: np.array([0.0, 0.08 * n - 0.88, -3.0]), country)[-1]
    assert found[[-2, -1]].all()
    assert not found[1] and not found[2]


@pytest.mark.parametrize(
    ("down_deg", "to_the_right_deg", "sees"),
    [(0, 0, True), (14, 0, True), (14, 100, True), (18, 0, False), (-18, 0, True), (-21, 0, False)],
)
def test_the_mount_must_let_the_field_be_seen(
    down_deg: float, to_the_right_deg: float, sees: bool
) -> None:
    """With 30 degrees to each edge it may look 16 degrees down, and 19 up."""
    down = rotation_from_vector(np.array([0.0, -np.radians(down_deg), 0.0]))
    turned = yaw_rotation(np.radians(to_the_right_deg)) @ down
    mount = Pose(turned @ AHEAD.rotation, np.zeros(3))
    camera = Camera(640, 480, 417.0, 417.0, 319.5, 239.5, body_from_camera=mount)
    assert can_see_free(camera) is sees


def test_an_unknown_mount_is_not_judged_nor_a_gimbal() -> None:
    assert can_see_free(replace(NARROW, body_from_camera=None))
    shut = replace(NARROW, height=100)
    assert not can_see_free(shut)
    assert can_see_free(replace(shut, gimbal=Gimbal()))
