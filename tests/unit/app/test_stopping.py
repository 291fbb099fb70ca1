from __future__ import annotations

import io
import os
import signal

import pytest

from companion.app.progress import Progress, TerminalProgress, progress_on
from companion.app.stopping import StopSignals


def test_signal_while_frames_run_waits_for_the_end_of_the_frame() -> None:
    with StopSignals() as signals:
        progress = signals.between_frames(Progress())
        progress.start(3)
        progress.update(1, "tracking", 0)
        os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            progress.update(2, "tracking", 0)
        assert signals.exit_status == 143


def test_second_signal_does_not_wait() -> None:
    with StopSignals() as signals:
        signals.between_frames(Progress()).start(3)
        os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
        assert signals.exit_status == 130


def test_signal_outside_the_frames_stops_at_once() -> None:
    with StopSignals() as signals:
        progress = signals.between_frames(Progress())
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
        progress.start(1)
        assert signals.exit_status == 130


def test_signal_after_the_last_frame_lets_the_results_be_written() -> None:
    with StopSignals() as signals:
        progress = signals.between_frames(Progress())
        progress.start(1)
        progress.update(1, "tracking", 0)
        progress.finish()
        os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            signals.take()
        assert signals.exit_status == 143


def test_progress_can_be_finished_after_a_stop() -> None:
    with StopSignals() as signals:
        progress = signals.between_frames(Progress())
        progress.start(3)
        os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            progress.update(1, "tracking", 0)
        progress.finish()


def test_handlers_are_put_back() -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with StopSignals():
        assert signal.getsignal(signal.SIGINT) != before[0]
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_no_terminal_means_silence() -> None:
    stream = io.StringIO()
    progress = progress_on(stream)
    progress.start(2)
    progress.update(2, "tracking", 5)
    progress.finish()
    assert stream.getvalue() == ""


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_terminal_shows_frames_state_and_points(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    stream = Terminal()
    progress = progress_on(stream)
    assert isinstance(progress, TerminalProgress)
    progress.start(200)
    progress.update(50, "initialising", 1234)
    progress.finish()
    shown = stream.getvalue()
    assert "50/200" in shown
    assert "initialising" in shown
    assert "1,234 points" in shown
