"""SIGINT and SIGTERM, deferred to the end of a frame."""

from __future__ import annotations

import signal
from types import FrameType
from typing import Any

from companion.app.progress import Progress


class StopSignals:
    """Context in which SIGINT and SIGTERM raise KeyboardInterrupt.

    Once frames run, the first signal waits for the end of the frame; after the last frame, while
    results are written, it is only kept in `received`. A second one never waits.
    """

    def __init__(self) -> None:
        self.received: signal.Signals | None = None
        self._deferred = False
        self._before: dict[signal.Signals, object] = {}

    def __enter__(self) -> StopSignals:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    @property
    def exit_status(self) -> int:
        """Exit status of a program stopped by a signal: 130 or 143."""
        return 128 + (self.received or signal.SIGINT)

    def between_frames(self, progress: Progress) -> Progress:
        """The same progress, at whose updates a stop takes effect."""
        return _StoppableProgress(progress, self)

    def defer(self) -> None:
        """From here on the first signal waits for `take`."""
        self._deferred = True

    def take(self) -> None:
        """Raise KeyboardInterrupt when a signal has come."""
        if self.received is not None:
            raise KeyboardInterrupt

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        first = self.received is None
        if first:
            self.received = signal.Signals(number)
        if not (first and self._deferred):
            raise KeyboardInterrupt


class _StoppableProgress(Progress):
    def __init__(self, inner: Progress, signals: StopSignals) -> None:
        self._inner = inner
        self._signals = signals

    def start(self, total_frames: int) -> None:
        self._inner.start(total_frames)
        self._signals.defer()

    def show(self, **facts: Any) -> None:
        self._inner.show(**facts)

    def update(self, done: int, state: str, n_points: int) -> None:
        self._inner.update(done, state, n_points)
        self._signals.take()

    def finish(self) -> None:
        self._inner.finish()
