"""Progress of a replay or a calibration: as a bar for people, as JSON for programs."""

from __future__ import annotations

import json
from typing import Any, TextIO


class Progress:
    """Receives updates between frames; this one shows nothing."""

    def start(self, total_frames: int) -> None:
        """Called before the first frame; `total_frames` is 0 where unknown."""

    def update(self, done: int, state: str, n_points: int) -> None:
        """Called after each frame: frames done, state, points (or views) so far."""

    def show(self, **facts: Any) -> None:
        """Called before an update that has more to tell, in plain types."""

    def finish(self) -> None:
        """Called after the last frame."""


class TerminalProgress(Progress):
    """Progress bar: frames (or `unit`) done, their rate, state, points."""

    def __init__(self, stream: TextIO, counted: str = "points", unit: str = "frames") -> None:
        from companion.app.progress_bar import progress_bar  # a tenth of a second of imports

        self._bar = progress_bar(stream, counted, unit)
        self._task = self._bar.add_task(
            "", start=False, visible=False, total=None, state="", points=0
        )

    def start(self, total_frames: int) -> None:
        """Show the bar."""
        self._bar.reset(self._task, total=total_frames or None, visible=True, state="", points=0)
        self._bar.start()

    def update(self, done: int, state: str, n_points: int) -> None:
        """Move the bar."""
        self._bar.update(self._task, completed=done, state=state, points=n_points)

    def finish(self) -> None:
        """Leave the bar as it stands."""
        self._bar.stop()


class JsonProgress(Progress):
    """A line of JSON for each update: `done`, `total` (0 where unknown), `state`, `count`."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._facts: dict[str, Any] = {"total": 0}

    def start(self, total_frames: int) -> None:
        """Take the total."""
        self._facts["total"] = total_frames

    def show(self, **facts: Any) -> None:
        """Take what the lines from now on have too."""
        self._facts |= facts

    def update(self, done: int, state: str, n_points: int) -> None:
        """Write a line."""
        self._facts |= {"done": done, "state": state, "count": n_points}
        print(json.dumps(self._facts), file=self._stream, flush=True)


def progress_on(stream: TextIO, counted: str = "points", unit: str = "frames") -> Progress:
    """Bar on a terminal, nothing elsewhere."""
    return TerminalProgress(stream, counted, unit) if stream.isatty() else Progress()
