"""The page's process: three words are heard, none while armed, and it ends with the daemon."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from itertools import chain, repeat
from pathlib import Path

import pytest

from companion.config_file import load_config
from companion.daemon import page_child
from companion.daemon.page_child import PageChild, SettingsSource
from companion.daemon.stop_request import RESTART, StopRequest
from drivers.system.journal import Journal


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_child, "PAGE", "tests.support.processes.tiny_page_child")


async def heard(
    words: str, armed: Callable[[], bool], until: Callable[[list[str], StopRequest, str], bool],
    capsys: pytest.CaptureFixture[str],
) -> tuple[list[str], StopRequest, str]:  # fmt: skip
    """Reloads, the stop request and the journal, once that is as wanted."""
    journal, reloads = Journal({}), list[str]()
    stop, said = StopRequest(journal), ""
    child = PageChild(
        load_config(None, [f"daemon.flights={words}"]), SettingsSource(), Path("status.sock"), True,
        journal, armed, lambda: reloads.append("reload"),
        lambda: reloads.append("viewer"), stop,
    )  # fmt: skip
    task = asyncio.ensure_future(child.run())
    try:
        for _ in range(1000):
            said += capsys.readouterr().err
            if until(reloads, stop, said):
                return reloads, stop, said
            await asyncio.sleep(0.02)
        raise AssertionError(f"not in time: {reloads} {said}")
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


def test_it_may_ask_for_three_things(capsys: pytest.CaptureFixture[str]) -> None:
    reloads, stop, _ = asyncio.run(
        heard(
            "reload,format the disk,viewer,reload,restart",
            lambda: False,
            lambda r, s, _: s.made,
            capsys,
        )
    )
    assert reloads == ["reload", "viewer", "reload"] and stop.status == RESTART and stop.hurried


def test_but_for_nothing_while_armed(capsys: pytest.CaptureFixture[str]) -> None:
    reloads, stop, said = asyncio.run(
        heard("restart,viewer,reload", lambda: True, lambda r, s, said: "no reload" in said, capsys)
    )
    assert not reloads and not stop.made and "no restart: the motors are armed" in said


def test_one_that_ends_is_started_again(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page_child, "FIRST_PAUSE_S", 0.01)
    asyncio.run(
        heard(
            "end", lambda: False, lambda r, s, said: said.count("has ended (status 7)") == 2, capsys
        )
    )


def test_one_that_writes_without_end_is_ended(capsys: pytest.CaptureFixture[str]) -> None:
    asyncio.run(
        heard("x" * 5000, lambda: False, lambda r, s, said: "what it never writes" in said, capsys)
    )


def test_it_is_told_when_the_motors_are_armed_and_when_no_longer(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page_child, "ARMED_EVERY_S", 0.01)
    states = chain([False, False, True, True], repeat(False))
    words = "heed give way,heed take back,end"
    asyncio.run(
        heard(
            words, lambda: next(states), lambda r, s, said: "has ended (status 7)" in said, capsys
        )
    )
