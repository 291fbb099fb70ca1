"""A stage's process tells the daemon what shared memory it has taken, but not of each frame."""

from __future__ import annotations

import socket
from typing import Any

import numpy as np

from companion.messages import Frame
from companion.runtime.parcel import Parcel
from companion.runtime.stage_child import TOLD_BYTES, _Loop
from companion.runtime.stage_protocol import Finish, Taken
from companion.runtime.stage_work import Work
from companion.runtime.stages import UNREAD_BYTES, stage_named

N_FRAMES = 12


class Outliving(Work):
    """Work that ends by itself when the daemon is gone."""

    outlives_daemon = True

    def step(self, message: Any) -> list[Any]:
        return []

    def finish(self, finish: Finish) -> list[Any]:
        return []


def test_what_is_taken_is_told_every_few_frames() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    grey, rgb = np.zeros((480, 640), np.uint8), np.zeros((480, 640, 3), np.uint8)
    frames = [Parcel.of(Frame(n, n, grey, rgb)) for n in range(N_FRAMES)]
    told: list[Any] = []
    with ours, theirs:
        for frame in frames:
            frame.send(ours)
        ours.shutdown(socket.SHUT_WR)
        _Loop(stage_named("recorder"), Outliving(), waits=False).read(theirs, told.append)
    assert all(isinstance(each, Taken) for each in told)
    assert len(told) == N_FRAMES // 4
    whole = sum(frame.n_bytes for frame in frames)
    marks = [0, *(each.n_bytes for each in told), whole]
    untold = np.diff(marks)
    # who waits until less than UNREAD_BYTES are on their way is always woken again
    assert (untold[:-1] >= TOLD_BYTES).all() and untold[-1] < TOLD_BYTES < UNREAD_BYTES
