"""What is drawn of approaches does not glitter."""

import numpy as np
import pytest

from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose
from tests.support.flights import approach_scene
from tests.support.flights.approach_scene import ApproachScene, Sheet

AHEAD = Pose(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.zeros(3))
CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)


def test_a_far_wall_is_drawn_as_the_mean_of_many_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 3 m a pixel covers three texels: single rays into the finest texture are 20 greys off."""
    scene = ApproachScene([
        Sheet(np.array([3.0, -9, -9]), np.array([0, 18.0, 0]), np.array([0, 0, 18.0]), 2)
    ])  # fmt: skip
    drawn = scene.picture(CAMERA, AHEAD).astype(float)
    monkeypatch.setattr(approach_scene, "SAMPLES", 12)
    exact = scene.picture(CAMERA, AHEAD).astype(float)
    assert exact.std() > 15
    assert np.abs(drawn - exact).mean() < 4
    assert scene.depth(CAMERA, AHEAD) == pytest.approx(3.0, abs=1e-4)
