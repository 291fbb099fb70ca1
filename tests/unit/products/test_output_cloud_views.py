from __future__ import annotations

import cv2
import numpy as np
import pytest

from companion.geometry.transforms import Array
from companion.messages import Bytes
from companion.products.cloud import Cloud
from companion.products.report.cloud_views import (
    CloudView,
    cloud_views,
    compass_point,
    round_length,
    side_heading_rad,
    splat,
    view_axes,
)

NORTH, EAST, UP = np.eye(3)[0], np.eye(3)[1], -np.eye(3)[2]
RED, GREEN, BLUE = (200, 20, 20), (20, 200, 20), (20, 20, 200)


def cloud(points: Array, rgb: Bytes) -> Cloud:
    nothing = np.zeros((len(points), 3), np.float32)
    ones = np.ones(len(points), np.float32)
    return Cloud(points.astype(np.float32), rgb, ones, nothing, ones)


def plate() -> Cloud:
    """Ground 30 m to the north by 40 m to the east: red in the north-east, green elsewhere."""
    x, y = np.meshgrid(np.arange(0, 30, 0.2), np.arange(0, 40, 0.2), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    rgb = np.where(((points[:, 0] > 15) & (points[:, 1] > 20))[:, None], RED, GREEN)
    return cloud(points, rgb.astype(np.uint8))


def decode(view: CloudView) -> tuple[Bytes, Bytes]:
    """Colours (H, W, 3) and opacity (H, W)."""
    image = cv2.imdecode(np.frombuffer(view.webp, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None and image.shape == (view.height_px, view.width_px, 4)
    return image[..., 2::-1].astype(np.uint8), image[..., 3].astype(np.uint8)


@pytest.fixture(scope="module")
def from_above() -> CloudView:
    return cloud_views(plate(), [])[0]


def test_plan_view_has_north_up_and_east_right(from_above: CloudView) -> None:
    rgb, opacity = decode(from_above)
    rows, columns = np.nonzero(opacity > 200)
    middle = (rows.min() + rows.max()) / 2, (columns.min() + columns.max()) / 2
    red = rgb[rows, columns, 0] > rgb[rows, columns, 1]
    up_right = (rows < middle[0] - 4) & (columns > middle[1] + 4)
    elsewhere = (rows > middle[0] + 4) | (columns < middle[1] - 4)
    assert red[up_right].mean() > 0.98
    assert red[elsewhere].mean() < 0.02


def test_a_dense_plate_has_no_holes(from_above: CloudView) -> None:
    _, opacity = decode(from_above)
    rows, columns = np.nonzero(opacity > 200)
    inner = opacity[rows.min() + 5 : rows.max() - 5, columns.min() + 5 : columns.max() - 5]
    assert (inner > 200).mean() > 0.995


def test_scale_bar_is_to_scale() -> None:
    corners = np.array([[0, 0, -5.0], [30, 0, -5], [30, 40, -5]])
    view = cloud_views(plate(), [corners])[0]
    (path,) = view.paths
    px_per_m = np.linalg.norm(path[2] - path[1]) / 40
    assert view.bar_px == pytest.approx(view.bar * px_per_m)
    assert 0.08 < view.bar_px / view.width_px <= 0.25


def test_path_lies_over_the_points_below_it() -> None:
    view = cloud_views(plate(), [np.array([[15.0, 20.0, -30.0], [29.0, 39.0, -30.0]])])[0]
    rgb, _ = decode(view)
    start, end = view.paths[0].round().astype(int)
    assert rgb[end[1] + 8, end[0] - 8, 0] > 150  # in the red corner
    assert rgb[start[1] + 8, start[0] - 8, 1] > 150


def test_whole_path_is_in_every_view() -> None:
    path = np.array([[-50.0, 10, -5], [10, 90, -60], [80, -20, -20]])
    for view in cloud_views(plate(), [path]):
        assert (view.paths[0] > 0).all()
        assert (view.paths[0] < [view.width_px, view.height_px]).all()


def test_the_nearest_point_is_on_top_whatever_the_order() -> None:
    pixels = np.array([[5.0, 5.0], [6.0, 5.0], [5.0, 6.0]])
    rgb = np.array([RED, GREEN, BLUE], np.uint8)
    ahead = np.array([3.0, 1.0, 2.0])
    for order in ([0, 1, 2], [2, 1, 0], [1, 2, 0]):
        picture, nearest = splat(pixels[order], ahead[order], rgb[order], 12, 12, 3)
        assert tuple(picture[5, 5]) == GREEN
        assert tuple(picture[6, 4]) == BLUE
        assert tuple(picture[4, 4]) == RED
        assert nearest[5, 5] == 1
        assert np.isinf(nearest[0, 0])
        assert np.isfinite(nearest).sum() == 9 + 3 + 3


def test_points_outside_the_picture_are_left_out() -> None:
    pixels = np.array([[-50.0, 2.0], [2.0, 400.0], [0.0, 0.0]])
    _, nearest = splat(pixels, np.ones(3), np.zeros((3, 3), np.uint8), 8, 8, 3)
    assert np.isfinite(nearest).sum() == 4


def test_axes_of_views() -> None:
    right, up, ahead = view_axes(0.0, np.pi / 2)
    assert np.allclose([right, up, ahead], [EAST, NORTH, -UP])
    right, up, ahead = view_axes(np.pi / 2, 0.0)
    assert np.allclose([right, up, ahead], [-NORTH, UP, EAST])
    slant = view_axes(0.7, 0.6)
    assert np.allclose(slant @ slant.T, np.eye(3))
    assert slant[1] @ UP > 0.5


@pytest.mark.parametrize("east", [-30.0, 60.0])
def test_a_wall_is_seen_from_where_the_camera_flew(east: float) -> None:
    rng = np.random.default_rng(1)
    wall = rng.uniform([0, 19.5, -12], [40, 20.5, 0], (500, 3))
    flown = [np.array([[0, east, -6.0], [40, east, -6]])]
    heading = side_heading_rad(cloud(wall, np.zeros((500, 3), np.uint8)), flown)
    assert compass_point(heading) == ("east" if east < 20 else "west")


def test_no_points_no_views() -> None:
    assert cloud_views(cloud(np.zeros((0, 3)), np.zeros((0, 3), np.uint8)), []) == []


@pytest.mark.parametrize(
    ("at_most", "bar"), [(37, 20), (50, 50), (1, 1), (0.999, 0.5), (0.0021, 0.002), (9999, 5000)]
)
def test_bars_are_round(at_most: float, bar: float) -> None:
    assert round_length(at_most) == pytest.approx(bar)
