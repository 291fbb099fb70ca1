"""What the camera sees, as a process."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from companion.clock import monotonic_s
from companion.depth.device_choice import choose_device
from companion.depth.stage import DepthStage
from companion.messages import Message
from companion.stages.protocol import Finish, SetShare, Setup
from companion.stages.work import Work


class _Depth(Work):
    def __init__(self, setup: Setup) -> None:
        super().__init__()
        opened = choose_device(setup.config.opencl, monotonic_s)
        self.device = opened.described
        self._stage = DepthStage(
            setup.config.depth, setup.config.cloud, setup.camera, opened, self.times
        )

    def step(self, message: Any) -> Iterable[Message]:
        if isinstance(message, SetShare):
            self._stage.set_share(message.share)
            return []
        return self._stage.step(message)

    def finish(self, finish: Finish) -> Iterable[Message]:
        return [] if finish.hurry else self._stage.flush()


def work(setup: Setup) -> Work:
    """The stage that a setup asks for."""
    return _Depth(setup)
