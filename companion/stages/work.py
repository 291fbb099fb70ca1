"""What each kind of stage does with a message."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack
from typing import Any, Protocol

from companion.clock import StageTimes
from companion.depth.opencl import open_device
from companion.depth.stage import DepthStage
from companion.errors import StageError
from companion.localisation import LocalisationStage
from companion.messages import Message
from companion.output.flight_result import FlightResult
from companion.output.write import write_results
from companion.stages.frame_ring import FrameInRing
from companion.stages.protocol import Finish, SetShare, Setup
from companion.viewer import FileViewer

MOST_HELD = 32


class Work(Protocol):
    """A stage as its process sees it."""

    times: StageTimes
    device: str
    skips: bool
    """Whether it wants the latest frame only, and that without its colours."""
    n_held: int
    """Frames that wait."""

    @property
    def has_room(self) -> bool:
        """Whether another frame may wait."""

    def may_skip(self, message: Any) -> bool:
        """Whether a message gives way to a newer one of its kind."""

    def step(self, message: Any) -> Iterable[Message]:
        """Take one message."""

    def finish(self, finish: Finish) -> Iterable[Message]:
        """Give what is left."""


class _Common:
    skips = False
    device = ""

    def __init__(self) -> None:
        self.times = StageTimes()
        self.n_held = 0

    @property
    def has_room(self) -> bool:
        return self.n_held < MOST_HELD

    def may_skip(self, message: Any) -> bool:
        return self.skips and isinstance(message, FrameInRing)


class _Localisation(_Common):
    """Where the camera is."""

    skips = True

    def __init__(self, setup: Setup) -> None:
        super().__init__()
        self._stage = LocalisationStage(setup.config, setup.camera, self.times, beside=True)

    def step(self, message: Any) -> Iterable[Message]:
        if isinstance(message, SetShare):
            self._stage.set_effort(message.share)
            return []
        return self._stage.step(message)

    def finish(self, finish: Finish) -> Iterable[Message]:
        return self._stage.finish(adjust=not finish.hurry)


class _Depth(_Common):
    """What the camera sees."""

    def __init__(self, setup: Setup) -> None:
        super().__init__()
        opened = open_device(setup.config.opencl)
        self.device = opened.name
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


class _Recorder(_Common):
    """What is left of the flight: the recording, and its results when it is over."""

    def __init__(self, setup: Setup) -> None:
        super().__init__()
        if setup.folder is None:
            raise StageError("a recorder needs a folder")
        self._setup, self._folder = setup, setup.folder
        self._result = FlightResult()
        self._open = ExitStack()
        self._folder.mkdir(parents=True, exist_ok=True)
        self._recording = self._open.enter_context(
            FileViewer(setup.config.viewer, setup.camera, self._folder / "flight.rrd")
        )

    def step(self, message: Any) -> Iterable[Message]:
        self._result.take(message)
        self._recording.take(message)
        return []

    def finish(self, finish: Finish) -> Iterable[Message]:
        if finish.facts is not None:
            write_results(
                self._folder, self._result, finish.facts, self._setup.config.cloud.voxel_m,
                page=not finish.hurry,
            )  # fmt: skip
        self._open.close()
        return []


def work_of(setup: Setup) -> Work:
    """The stage that a setup asks for."""
    kinds: dict[str, type[_Localisation | _Depth | _Recorder]] = {
        "localisation": _Localisation, "depth": _Depth, "recorder": _Recorder,
    }  # fmt: skip
    return kinds[setup.kind](setup)


