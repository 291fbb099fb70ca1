"""The port for viewers, which the flight before may still have."""

from __future__ import annotations

import socket

import pytest

from companion.config import Config, StreamConfig
from companion.geometry.camera import Camera
from companion.runtime.stage_protocol import Finish, Setup
from companion.stages import viewers_work
from companion.streaming.exporter import open_listener
from tests.support.waiting import until


def test_that_it_is_taken_is_told_only_where_it_stays_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewers_work, "BIND_AGAIN_S", 0.02)
    monkeypatch.setattr(viewers_work, "HELD_BY_OURS", 5)
    looked: list[str] = []
    opened: list[socket.socket] = []

    def looking(address: str) -> socket.socket:
        if address != viewers_work.OWN:
            looked.append(address)
        opened.append(open_listener(address))
        return opened[-1]

    monkeypatch.setattr("companion.stages.viewers_work.open_listener", looking)
    with socket.socket() as before:
        before.bind(("127.0.0.1", 0))
        before.listen()
        address = f"127.0.0.1:{before.getsockname()[1]}"
        config = Config(stream=StreamConfig(listen=address))
        stage = viewers_work.work(Setup(config, Camera(64, 48, 50, 50, 32, 24)))
        until(lambda: len(looked) >= 2)
        told_early = [stage.details()["closed"], len(looked)]
        until(lambda: stage.details()["closed"], "it is told")
    n_looked = len(looked)
    until(lambda: not stage.details()["closed"], "it has the port")
    stage.finish(Finish(hurry=True))
    for each in opened:  # whose process else ends with the stage
        each.close()
    assert told_early[0] == "" or told_early[1] > viewers_work.HELD_BY_OURS
    assert n_looked > viewers_work.HELD_BY_OURS
