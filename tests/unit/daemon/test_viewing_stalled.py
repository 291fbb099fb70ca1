from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import psutil
import pytest

from companion.config import Config
from companion.daemon.flights import viewing
from companion.daemon.nodes import remote_viewing
from companion.daemon.nodes.remote_viewing import RemoteViewing
from companion.messages import Frame
from companion.runtime.stages import stage_named
from tests.support.flights.topic_flight import CAMERA


def test_an_exporter_that_hangs_is_ended_and_another_takes_its_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    impatient = replace(stage_named("viewers"), answer_s=1.0)
    monkeypatch.setattr(remote_viewing, "stage_named", lambda name: impatient)
    config = Config()
    config = replace(config, stream=replace(config.stream, listen="127.0.0.1:0"))
    shape = CAMERA.height, CAMERA.width
    told: list[tuple[str, str]] = []
    looked_at = RemoteViewing(
        config, CAMERA, "flight", lambda what, detail, good: told.append((what, detail))
    )
    processes, until_s = looked_at._processes, time.monotonic() + 60
    try:
        while not processes.up:
            assert time.monotonic() < until_s, "it is not ready"
            time.sleep(0.01)
        first = processes.by_name["viewers"].pid
        psutil.Process(first).suspend()
        seq = 0
        while processes.n_restarted["viewers"] == 0 or not processes.by_name["viewers"].progress:
            assert time.monotonic() < until_s, "it is not ended"
            seq += 1
            grey = np.zeros(shape, np.uint8)
            looked_at.take(Frame(seq, seq * 100_000_000, grey, np.zeros((*shape, 3), np.uint8)))
            looked_at.step()
            time.sleep(0.01)
        assert processes.by_name["viewers"].pid != first
        assert told[0][0] == viewing.GONE and "it hung for" in told[0][1]
    finally:
        looked_at.close(hurry=True)
