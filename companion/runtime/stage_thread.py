"""A stage in a thread of its own, fed in order; whoever feeds it waits for room."""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Callable
from typing import Any

from companion.messages import Message
from companion.runtime.mailbox import DropPolicy, Mailbox
from companion.runtime.message_size import size_bytes
from companion.runtime.stage_protocol import Finish, Progress
from companion.runtime.stage_work import Work
from companion.runtime.stages import NICE_WITHOUT_LOSS

ROOM_BYTES = 128 << 20


class StageThread:
    """A stage that is begun in its thread; what it has given waits in `given`.

    The path waits for nobody but for whom it needs: this thread, and those that drivers start from
    it, run at a lower priority. A stage that raises ends: later messages are ignored, and `fault`
    is the exception.
    """

    def __init__(self, name: str, work: Work, tell: Callable[[Any], None]) -> None:
        self._work, self._tell = work, tell
        self._inbox: Mailbox[Message | Finish] = Mailbox(
            lambda _: DropPolicy.ALWAYS, size_bytes, ROOM_BYTES, waits=True
        )
        self.given: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._has_begun = threading.Event()
        self.fault: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()
        self._has_begun.wait()
        if self.fault is not None:
            raise self.fault

    @property
    def progress(self) -> Progress:
        """Progress now."""
        return self._work.progress

    def put(self, message: Message) -> None:
        """Pass a message; waits for room."""
        self._inbox.put(message)

    def ask_to_finish(self, finish: Finish) -> None:
        """Have it finish beside what else is done; then `close`."""
        self._inbox.put(finish)

    def close(self) -> None:
        """Wait until it has finished; the last results are given then."""
        self._thread.join()

    def _run(self) -> None:
        os.nice(NICE_WITHOUT_LOSS)
        try:
            self._work.begin(self._tell)
            self._has_begun.set()
            while not isinstance(message := self._inbox.get(), Finish):
                for out in self._work.step(message):
                    self.given.put(out)
            for out in self._work.finish(message):
                self.given.put(out)
        except BaseException as fault:  # raised or reported in the caller's thread
            self.fault = fault
        self._inbox.close()  # so that `put` does not wait for ever
        self._has_begun.set()
