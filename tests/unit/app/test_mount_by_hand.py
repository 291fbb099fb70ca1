"""The search of the mount beside a daemon, on a computer that leaves it little time."""

from __future__ import annotations

from typing import cast

import numpy as np
import pytest

from companion.app import mount_command
from companion.app.mount_command import SILENT_S
from companion.messages import Frame
from drivers.recording.recording_tail import RecordingTail


class Growing:
    """A recording that grows by so many frames, one for each look."""

    def __init__(self, n: int) -> None:
        self._left = list(range(n))

    def read(self) -> list[Frame]:
        """New frames; none once all were read."""
        if not self._left:
            return []
        seq = self._left.pop(0)
        return [Frame(seq, seq * 10**9, np.zeros((2, 2), np.uint8), np.zeros((2, 2, 3), np.uint8))]


def test_frames_that_take_long_do_not_end_it_but_silence_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s = [0.0]

    def wait_s(_event: object, seconds: float) -> None:
        now_s[0] += seconds

    monkeypatch.setattr(mount_command, "monotonic_s", lambda: now_s[0])
    monkeypatch.setattr(mount_command, "wait_s", wait_s)
    seen, ended_s = [], 0.0
    for message in mount_command._live(cast("RecordingTail", Growing(3))):
        assert isinstance(message, Frame)
        seen.append(message.seq)
        now_s[0] += 2 * SILENT_S  # its localisation is slow
        ended_s = now_s[0]
    assert seen == [0, 1, 2]
    assert SILENT_S < now_s[0] - ended_s < SILENT_S + 1.0
