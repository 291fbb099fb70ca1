"""Keeping the viewer on board open."""

from __future__ import annotations

import errno
import threading
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from companion.config import Config
from companion.daemon.flights import viewing
from companion.daemon.flights.viewing import GONE, NO_VIEWER, SHOWN, Viewing

SOON_S = 30.0


def test_a_viewer_without_a_process_is_opened_later(monkeypatch: pytest.MonkeyPatch) -> None:
    refusals = [OSError(errno.ENOMEM, "Cannot allocate memory")] * 2

    def open_viewer(*_: Any) -> Any:
        if refusals:
            raise refusals.pop()
        return SimpleNamespace(is_shown=True, page="http://here", close=lambda patience_s: None)

    monkeypatch.setattr(viewing, "OnboardViewer", open_viewer)
    monkeypatch.setattr(viewing, "AGAIN_S", 0.0)
    config, warned, shown = Config(), list[tuple[str, str]](), threading.Event()
    exporter: Any = SimpleNamespace(progress=None, n_dropped=0)

    def warn(what: str, detail: str, _good: bool) -> None:
        warned.append((what, detail))
        if what == SHOWN:
            shown.set()

    config = replace(config, daemon=replace(config.daemon, viewer="web"))
    opened = Viewing(config, lambda: exporter, warn)
    opened.take_port(1)
    assert shown.wait(SOON_S), warned
    opened.close(hurry=True)
    assert warned == [
        (NO_VIEWER, "[Errno 12] Cannot allocate memory"), (SHOWN, "open http://here")
    ]  # fmt: skip


def test_a_viewer_that_ends_with_its_flight_is_not_opened_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    onboard = SimpleNamespace(is_shown=True, page="http://here", close=lambda patience_s: None)
    monkeypatch.setattr(viewing, "OnboardViewer", lambda *_: onboard)
    monkeypatch.setattr(viewing, "LOOK_S", 0.01)
    config, warned, looks = Config(), list[str](), threading.Semaphore(0)

    def exporter() -> Any:
        looks.release()
        return SimpleNamespace(progress=None, n_dropped=0)

    def wait_for_looks() -> None:
        for _ in range(6):
            assert looks.acquire(timeout=SOON_S), warned

    config = replace(config, daemon=replace(config.daemon, viewer="web"))
    shown = Viewing(config, exporter, lambda what, *_: warned.append(what))
    shown.take_port(1)
    wait_for_looks()
    onboard.is_shown = False
    wait_for_looks()
    assert warned[:3] == [SHOWN, GONE, SHOWN], "in flight it is opened again"
    onboard.is_shown = True
    wait_for_looks()
    shown.open_no_more()
    wait_for_looks()
    n_warned = len(warned)
    onboard.is_shown = False
    wait_for_looks()
    shown.close(hurry=True)
    assert len(warned) == n_warned
