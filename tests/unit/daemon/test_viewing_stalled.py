from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import psutil
import pytest

from companion.config import Config
from companion.daemon.flights import viewing
from companion.daemon.flights.viewing import Viewing
from companion.messages import Frame
from tests.support.flights.topic_flight import CAMERA


def test_an_exporter_that_hangs_is_ended_and_another_takes_its_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(viewing, "STALLED_S", 1.0)
    monkeypatch.setattr(viewing, "LOOK_S", 0.1)
    config = Config()
    config = replace(config, stream=replace(config.stream, listen="127.0.0.1:0"))
    shape = CAMERA.height, CAMERA.width
    told: list[str] = []
    looked_at = Viewing(config, CAMERA, "flight", lambda what, detail, good: told.append(what))
    try:
        first = looked_at.pid
        psutil.Process(first).suspend()
        seq, until_s = 0, time.monotonic() + 60
        while looked_at.pid == first:
            assert time.monotonic() < until_s, "it is not ended"
            seq += 1
            grey = np.zeros(shape, np.uint8)
            looked_at.take(Frame(seq, seq * 100_000_000, grey, np.zeros((*shape, 3), np.uint8)))
            time.sleep(0.01)
        assert looked_at.health().n_restarted == 1
        assert viewing.GONE in told
    finally:
        looked_at.close(hurry=True)
