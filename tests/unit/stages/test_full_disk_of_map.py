"""A disk that takes no more of the map: told once, and localisation goes on."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from companion.config import Config
from companion.messages import Frame, FrameTracked, Warned
from companion.pilot_messages import OTHER, of_warning
from companion.runtime.stage_protocol import Finish, Setup
from companion.stages import localisation_work
from companion.stages.localisation_work import IN_MEMORY
from tests.support.reference.synthetic_map import CAMERA


def test_it_is_told_once(tmp_path: Path) -> None:
    stage = localisation_work.work(Setup(Config(), CAMERA, tmp_path / "gone", is_live=False))
    grey = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    told = []
    for seq in range(4):
        out = list(stage.step(Frame(seq, seq * 100_000_000, grey, np.zeros((0, 0, 3), np.uint8))))
        assert any(isinstance(each, FrameTracked) for each in out)
        warned = [each for each in out if isinstance(each, Warned)]
        told.append([each for each in warned if each.what == IN_MEMORY])
        if seq == 1:
            file = stage._stage._tracker.atlas.far_file
            assert file is not None
            assert file.put([np.zeros(9)]) is None
    list(stage.finish(Finish(hurry=True)))
    assert [len(each) for each in told] == [0, 0, 1, 0]
    assert str(tmp_path) in told[2][0].detail
    assert of_warning(IN_MEMORY) not in (None, OTHER())
