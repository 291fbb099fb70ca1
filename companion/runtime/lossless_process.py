"""A stage in a process of its own of which nothing is lost: whoever feeds it waits for room."""

from __future__ import annotations

import queue
from collections.abc import Callable

from companion.errors import StageError
from companion.runtime.parcel import Parcel
from companion.runtime.stage_process import StageProcess
from companion.runtime.stage_protocol import Finish, Progress, Setup
from companion.runtime.stage_start import Start
from companion.runtime.stages import Stage


class LosslessProcess:
    """A stage that takes all messages in order, and gives what it would give here; as StageThread.

    What it has given waits in `given`, closed. A stage that raises ends: later messages are
    ignored, and `fault` is the exception.
    """

    def __init__(self, stage: Stage, start: Start, say: Callable[[str], None]) -> None:
        self.given: queue.SimpleQueue[Parcel] = queue.SimpleQueue()
        self._process = StageProcess(
            stage, start, self.given.put, lambda why: None, say, waits=True
        )

    def begin(self, setup: Setup) -> None:
        """Let it begin."""
        self._process.begin(setup)

    def wait_until_up(self) -> None:
        """Wait until it has begun; what it raises is raised."""
        self._process.up_or_gone.wait()
        if self.fault is not None:
            raise self.fault

    @property
    def progress(self) -> Progress:
        """Progress as it has last told."""
        return self._process.progress or Progress()

    @property
    def fault(self) -> BaseException | None:
        """Exception that has ended it; None without one."""
        process = self._process
        if not process.why or process.has_finished:
            return None
        if process.failed is not None:
            return process.failed.error()
        return StageError(f"the process of {process.stage.name}: {process.why}")

    def put(self, parcel: Parcel) -> None:
        """Pass a message; waits for room."""
        self._process.offer(parcel)

    def ask_to_finish(self, finish: Finish) -> None:
        """Have it finish beside what else is done; then `close`."""
        self._process.ask_to_finish(finish)

    def close(self) -> None:
        """Wait until it has finished; the last results are given then."""
        self._process.wait()
        self.kill()

    def kill(self) -> None:
        """End it now."""
        self._process.kill()
