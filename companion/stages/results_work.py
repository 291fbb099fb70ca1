"""Stage `results`: the viewer file of a flight while it is flown, and its results at the end."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

from companion.errors import StageError
from companion.messages import Frame, Message, PointChunk
from companion.messages.run_facts import RunFacts
from companion.products.flight_result import FlightResult
from companion.runtime.stage_protocol import (
    Finish,
    ResultsWritten,
    Setup,
    Snapshot,
    TakeSnapshot,
    WriteResults,
)
from companion.runtime.stage_work import Work
from companion.stages.cloud_snapshots import CloudSnapshots
from companion.streaming.viewer import FileViewer
from drivers.system.file_pages import give_back_library_pages

PICTURE_EVERY_NS = 60_000_000
"""Least interval of pictures in the viewer file, as viewers get them: to encode and log each frame
takes half of this stage's processor time."""


class _Results(Work):
    def __init__(self, setup: Setup) -> None:
        super().__init__()
        if setup.folder is None:
            raise StageError("the results need a folder")
        self._folder, self._voxel_m = setup.folder, setup.config.cloud.voxel_m
        self._is_live = setup.is_live
        self._drawn_ns = -PICTURE_EVERY_NS
        self._open = ExitStack()
        self._folder.mkdir(parents=True, exist_ok=True)
        self._result = FlightResult(self._folder, setup.config.cloud.memory_mb)
        self._snapshots = CloudSnapshots(self._folder, self._result, self._voxel_m)
        self._viewer_file = self._open.enter_context(
            FileViewer(
                setup.config.viewer,
                setup.camera,
                self._folder / setup.viewer_file,
                setup.origin,
                indexed=not setup.is_live,
            )
        )
        if setup.is_live:  # in a process of its own
            give_back_library_pages()

    def begin(self, tell: Callable[[Any], None]) -> None:
        """Load what makes the report, unless in flight, where it would take memory for long."""
        if not self._is_live:
            import companion.products.report.write_results  # noqa: F401

    def step(self, message: Any) -> Iterable[Message | Snapshot | ResultsWritten]:
        if isinstance(message, WriteResults):
            return [self._written_so_far(message.facts)]
        if isinstance(message, TakeSnapshot):
            self._snapshots.begin(message)
            return self._snapshots.step()
        if isinstance(message, PointChunk):
            message = kept(message)
        self._result.take(message)
        if not isinstance(message, Frame) or self._is_drawn(message):
            self._viewer_file.take(message)
        return self._snapshots.step()

    def _is_drawn(self, frame: Frame) -> bool:
        if frame.t_ns - self._drawn_ns < PICTURE_EVERY_NS:
            return False
        self._drawn_ns = frame.t_ns
        return True

    def finish(self, finish: Finish) -> Iterable[Message]:
        try:
            self._open.close()
        finally:  # a viewer file that cannot be written is no reason to lose the results
            if finish.facts is not None:
                self._write(finish.facts, page=not finish.hurry)
        self._result.close()
        return []

    def _written_so_far(self, facts: RunFacts) -> ResultsWritten:
        try:
            self._write(facts, page=True)
        except OSError as error:  # the flight goes on, and what was gathered is not to be lost
            return ResultsWritten(str(self._folder), error.strerror or str(error))
        return ResultsWritten(str(self._folder))

    def _write(self, facts: RunFacts, page: bool) -> None:
        # plots are made on the ground only: until then their library need not be in memory
        from companion.products.report.write_results import write_results

        write_results(self._folder, self._result, facts, self._voxel_m, page)


def kept(chunk: PointChunk) -> PointChunk:
    """The same with arrays of its own, to be kept for long."""
    return replace(
        chunk, points_camera=chunk.points_camera.copy(), rgb=chunk.rgb.copy(),
        confidence=chunk.confidence.copy(), normals_camera=chunk.normals_camera.copy(),
        sigma=chunk.sigma.copy(),
    )  # fmt: skip


work = _Results
"""The stage for a setup."""
