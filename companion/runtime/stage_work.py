"""Interface of a stage in its process, and the look-up of its module."""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol

from companion.messages import Frame, Message
from companion.runtime.stage_protocol import Finish, Progress, ResultsWritten, Setup, Snapshot
from companion.timing.clock import StageTimes


class Work(ABC):
    """Base class of stages; `step` and `finish` are theirs."""

    outlives_daemon = False
    """True if it finishes by itself when the daemon is gone; else it ends at once."""
    device = ""

    def __init__(self) -> None:
        self.times = StageTimes()

    @property
    def n_rejected(self) -> int:
        """Messages taken and then dropped."""
        return 0

    def details(self) -> Mapping[str, Any]:
        """Facts for its progress report, beside those that all stages have."""
        return {}

    @property
    def progress(self) -> Progress:
        """Progress now."""
        return Progress(
            n_dropped=self.n_rejected, times=self.times.summary(), device=self.device,
            details=self.details(),
        )  # fmt: skip

    def begin(self, tell: Callable[[Any], None]) -> None:  # noqa: B027 - most have nothing to do
        """Called before the first message; `tell` sends a message to the daemon at once."""

    def look_ahead(self, frame: Frame) -> None:  # noqa: B027 - most have nothing to do
        """A frame that will come by `step` later, in order; work on it may begin beside."""

    @abstractmethod
    def step(self, message: Any) -> Iterable[Message | Snapshot | ResultsWritten]:
        """Take one message."""

    @abstractmethod
    def finish(self, finish: Finish) -> Iterable[Message | Snapshot]:
        """Give the last results."""

    def save(self, finish: Finish) -> None:  # noqa: B027 - most have nothing to do
        """Write what nobody waits for, once the last results are on their way."""


class WorkModule(Protocol):
    """Module of a stage. Importing it loads all that the stage needs."""

    def work(self, setup: Setup) -> Work:
        """The stage for a setup."""


def module_of(kind: str) -> WorkModule:
    """Import the module `companion.stages.<kind>_work`."""
    module: Any = importlib.import_module(f"companion.stages.{kind}_work")
    loaded: WorkModule = module
    return loaded
