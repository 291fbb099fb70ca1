from __future__ import annotations

import cv2
import numpy as np
import pytest

from companion.geometry.camera import Camera, Distortion

PINHOLE = Camera(640, 480, 500.0, 490.0, 322.0, 237.0)
RADTAN = Camera(
    640, 480, 480.0, 479.0, 321.8, 237.8, Distortion.RADTAN, (-0.16, 0.05, 6e-4, -4e-4, 0.01)
)
FISHEYE = Camera(
    640, 480, 300.0, 301.0, 318.0, 242.0, Distortion.EQUIDISTANT, (-0.02, 0.006, -0.003, 0.0006)
)
ALL = pytest.mark.parametrize(
    "camera", [PINHOLE, RADTAN, FISHEYE], ids=["none", "radtan", "fisheye"]
)


def grid(camera: Camera) -> np.ndarray:
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 9), np.linspace(0, camera.height - 1, 7))
    return np.stack([u.ravel(), v.ravel()], 1)


@ALL
def test_pixel_round_trip(camera: Camera) -> None:
    pixels = grid(camera)
    rays = np.c_[camera.normalise(pixels), np.ones(len(pixels))]
    assert np.isfinite(rays).all()
    np.testing.assert_allclose(camera.project(3.0 * rays), pixels, atol=1e-4)


def test_projection_agrees_with_opencv(rng: np.random.Generator) -> None:
    points = np.c_[rng.uniform(-1, 1, (20, 2)), rng.uniform(2, 4, 20)]
    zero = np.zeros(3)
    for camera in (RADTAN, FISHEYE):
        coefficients = np.array(camera.coefficients)
        if camera is RADTAN:
            theirs, _ = cv2.projectPoints(points, zero, zero, camera.matrix(), coefficients)
        else:
            theirs, _ = cv2.fisheye.projectPoints(
                points[:, None], zero, zero, camera.matrix(), coefficients
            )
        np.testing.assert_allclose(camera.project(points), theirs[:, 0], atol=1e-6)


def test_points_behind_the_camera_are_nan() -> None:
    pixels = PINHOLE.project(np.array([[0.1, 0.2, -1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    assert np.isnan(pixels[:2]).all()
    np.testing.assert_allclose(pixels[2], [PINHOLE.cx, PINHOLE.cy])


def test_pixels_outside_the_fisheye_are_nan() -> None:
    assert np.isnan(FISHEYE.normalise(np.array([[5000.0, 242.0]]))).all()


@ALL
def test_jacobian_matches_finite_differences(camera: Camera) -> None:
    n = camera.normalise(grid(camera))[10:20]
    step = 1e-5
    jacobian = camera.pixel_from_normalised_jacobian(n)
    for axis in range(2):
        moved = n + step * np.eye(2)[axis]
        slope = (
            camera.project(np.c_[moved, np.ones(10)]) - camera.project(np.c_[n, np.ones(10)])
        ) / step
        np.testing.assert_allclose(jacobian[..., axis], slope, atol=0.05)


def test_pinhole_of_a_distorted_camera() -> None:
    plain = RADTAN.pinhole()
    assert plain.distortion is Distortion.NONE
    np.testing.assert_array_equal(plain.matrix(), RADTAN.matrix())
