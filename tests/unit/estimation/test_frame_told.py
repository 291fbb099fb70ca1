"""What a pose came of is told before it: a process may be killed as soon as the pose is given."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np

from companion.config import Config
from companion.estimation.localisation import LocalisationStage
from companion.messages import Frame, FrameTracked, Odometry
from tests.support.reference.synthetic_map import CAMERA


def test_before_each_pose() -> None:
    stage = LocalisationStage(Config(), CAMERA, lambda _: nullcontext())
    grey = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    for seq in range(3):
        given = stage.step(Frame(seq, seq * 100_000_000, grey, np.zeros((0, 0, 3), np.uint8)))
        told = [each for each in given if isinstance(each, FrameTracked | Odometry)]
        assert [type(each) for each in told] == [FrameTracked, Odometry]
        assert {each.seq for each in told} == {seq}
