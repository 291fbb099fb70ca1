"""What is said before tracking fails, of made-up frames over a level ground of points."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.odometry.tracking_margin import (
    AWAY,
    TOO_FAINT,
    TOO_FAST,
    TOO_FEW,
    TrackingMargin,
)
from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose
from companion.messages import Track, TrackState, Warned
from companion.slam.features.orb_features import features_of
from companion.slam.features.view import View
from companion.slam.map.sparse_map import SlamMap

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
RATE_HZ, HEIGHT = 20, 10.0
GREY = np.zeros((240, 320), np.uint8)


class Flight:
    """Frames of a camera that looks down and goes over points at a speed, in heights a second."""

    def __init__(self) -> None:
        rng = np.random.default_rng(1)
        self.map = SlamMap(1.2, 8)
        self.map.positions = np.c_[rng.uniform([-60, -8], [600, 8], (40_000, 2)), np.zeros(40_000)]
        self.margin = TrackingMargin(CAMERA, 1200)
        self._north, self._seq = 0.0, 0

    def fly(
        self, seconds: float, heights_s: float = 0.5, n_matches: int = 300, n_seen: int = 1200,
        ratio: float = 1.0, drowned: bool = False,
    ) -> list[Warned]:  # fmt: skip
        """Frames that are tracked, or with no match lost; what is said."""
        said: list[Warned] = []
        for _ in range(round(seconds * RATE_HZ)):
            self._north += heights_s * HEIGHT / RATE_HZ
            self._seq += 1
            tracked = n_matches > 0
            state = TrackState.TRACKING if tracked else TrackState.LOST
            t_ns = round(self._seq * 1e9 / RATE_HZ)
            track = Track(self._seq, t_ns, state, n_inliers=n_matches, n_matches=n_matches)
            view = self._view(t_ns, n_matches) if tracked else None
            said += self.margin.take(track, view, self.map, n_seen, ratio, drowned)
        return said

    def _view(self, t_ns: int, n: int) -> View:
        pose = Pose(np.eye(3), np.array([-self._north, 0.0, HEIGHT]))
        pixels = CAMERA.project(pose.apply(self.map.positions))
        ids = np.flatnonzero(((pixels > 31) & (pixels < [289, 209])).all(1))[:: max(1, 500 // n)]
        m = len(ids)
        features = features_of(
            CAMERA, 1.2, pixels[ids].astype(np.float32), CAMERA.normalise(pixels[ids]),
            np.zeros(m, np.int64), np.zeros(m, np.float32), np.zeros((m, 32), np.uint8),
        )  # fmt: skip
        return View(self._seq, t_ns, features, None, GREY, pose, ids)


@pytest.mark.parametrize(
    ("worse", "what"),
    [
        ({"heights_s": 6.0}, TOO_FAST),
        ({"n_matches": 60, "n_seen": 400}, TOO_FAINT),
        ({"n_matches": 60}, TOO_FEW),
        ({"n_matches": 0, "n_seen": 200}, TOO_FAINT),
    ],
)
def test_a_limit_is_said_once_within_a_second_and_when_it_is_away(
    worse: dict[str, float], what: str
) -> None:
    flight = Flight()
    assert flight.fly(3.0) == []
    assert [w.what for w in flight.fly(1.0, **worse)] == [what]  # type: ignore[arg-type]
    assert flight.fly(5.0, **worse) == []  # type: ignore[arg-type]
    (away,) = flight.fly(5.0)
    assert (away.what, away.good) == (AWAY, True)
    assert [w.what for w in flight.fly(1.0, **worse)] == [what]  # type: ignore[arg-type]


def test_another_limit_is_said_beside_the_first() -> None:
    flight = Flight()
    assert [w.what for w in flight.fly(2.0, heights_s=6.0)] == [TOO_FAST]
    assert [w.what for w in flight.fly(2.0, n_matches=60)] == [TOO_FEW]


def test_nothing_is_said_of_a_moment_nor_of_features_left_out_under_load() -> None:
    flight = Flight()
    assert flight.fly(3.0) == []
    assert flight.fly(0.3, n_matches=60) == []
    assert flight.fly(3.0) == []
    assert flight.fly(3.0, n_matches=80, n_seen=460, ratio=0.5) == []


def test_a_loss_over_rich_ground_is_no_limit() -> None:
    flight = Flight()
    assert flight.fly(3.0) == []
    assert flight.fly(3.0, n_matches=0) == []


def test_a_picture_drowned_in_noise_is_told_with_all_its_matches() -> None:
    flight = Flight()
    assert flight.fly(2.0) == []
    (said,) = flight.fly(1.0, drowned=True)
    assert said.what == TOO_FAINT
