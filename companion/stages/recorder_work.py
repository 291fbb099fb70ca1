"""Stage `recorder`: the MCAP recording of a flight, all its input and what it sent."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from companion.errors import StageError
from companion.flight_notes import LinkReads
from companion.messages import Message
from companion.products.versions import versions
from companion.runtime.stage_protocol import Finish, Setup
from companion.runtime.stage_work import Work
from drivers.recording.recorder import Recorder
from drivers.system.file_pages import give_back_library_pages


class _Recorder(Work):
    outlives_daemon = True

    def __init__(self, setup: Setup) -> None:
        super().__init__()
        if setup.folder is None:
            raise StageError("a recorder needs a folder")
        setup.folder.mkdir(parents=True, exist_ok=True)
        self._recorder = Recorder(setup.folder, setup.config, setup.camera, versions())
        if setup.is_live:  # in a process of its own
            give_back_library_pages()

    @property
    def n_rejected(self) -> int:
        """Images and other messages dropped because the disk was full or too slow."""
        return self._recorder.n_dropped.total()

    def step(self, message: Any) -> Iterable[Message]:
        for each in message.parts if isinstance(message, LinkReads) else (message,):
            self._recorder.take(each)
        return self._recorder.warnings()

    def finish(self, finish: Finish) -> Iterable[Message]:
        self._recorder.close()
        return self._recorder.warnings()


work = _Recorder
"""The stage for a setup."""
