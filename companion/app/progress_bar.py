"""Progress bar on a terminal."""

from __future__ import annotations

from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, Task, TextColumn
from rich.progress import Progress as RichProgress
from rich.progress import TimeRemainingColumn as RemainingColumn
from rich.text import Text


def progress_bar(stream: TextIO, counted: str, unit: str) -> RichProgress:
    """Bar of `unit` done, their rate, the field `state`, and `points` with what is counted."""
    return RichProgress(
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(unit),
        _PerSecond(unit),
        TextColumn("{task.fields[state]}"),
        *([TextColumn("{task.fields[points]:,} " + counted)] if counted else []),
        RemainingColumn(),
        console=Console(file=stream),
    )


class _PerSecond(ProgressColumn):
    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.1f} {self._unit}/s")
