"""Where the camera is, as a process: always with the latest frame."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

from companion.localisation import LocalisationStage
from companion.messages import Message
from companion.slam.compiled.compiling import not_kept
from companion.stages.protocol import Finish, SetShare, Setup
from companion.stages.work import Work


class _Localisation(Work):
    latest_only = True

    def __init__(self, setup: Setup) -> None:
        super().__init__()
        if not_kept:
            print(
                f"companion: {len(not_kept)} compiled loops cannot be kept ({not_kept[0]}): every "
                "start compiles them; NUMBA_CACHE_DIR names a folder for them",
                file=sys.stderr,
            )
        self._stage = LocalisationStage(setup.config, setup.camera, self.times, beside=True)

    def step(self, message: Any) -> Iterable[Message]:
        if isinstance(message, SetShare):
            self._stage.set_effort(message.share)
            return []
        return self._stage.step(message)

    def finish(self, finish: Finish) -> Iterable[Message]:
        return self._stage.finish(adjust=not finish.hurry)


def work(setup: Setup) -> Work:
    """The stage that a setup asks for."""
    return _Localisation(setup)
