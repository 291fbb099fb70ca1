"""Threads, child processes, sockets and asyncio tasks that a test began and did not end."""

from __future__ import annotations

import asyncio
import os
import threading
import time
from collections.abc import Coroutine
from pathlib import Path
from typing import Any

import pytest

GRACE_S = 2.0
"""A thread that was told to end, or a child that was killed, may take so long."""
OWN = Path("/proc/self")


def running() -> dict[str, str]:
    """What this process has under way: a key for each, and in words what it is."""
    found = {f"thread {each.ident}": f"thread {each.name!r}" for each in threading.enumerate()}
    for task in (OWN / "task").iterdir():
        for pid in _text(task / "children").split():
            command = _text(Path("/proc", pid, "cmdline")).replace("\0", " ").strip()
            if command:  # one that ended and was not waited for has none
                found[f"process {pid}"] = f"process {command[:100]!r}"
    for name in os.listdir(OWN / "fd"):
        try:
            target = os.readlink(OWN / "fd" / name)
        except OSError:
            continue
        if target.startswith("socket:"):
            found[target] = target
    return found


def left_since(before: dict[str, str]) -> list[str]:
    """What is under way that was not, once it had time to end."""
    until_s = time.monotonic() + GRACE_S
    while True:
        left = [what for key, what in running().items() if key not in before]
        if not left or time.monotonic() > until_s:
            return left
        time.sleep(0.01)


def watch_tasks(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Tasks that are not done when an `asyncio.run` ends, as they come; it cancels them."""
    left: list[str] = []
    run = asyncio.run

    def watched(main: Coroutine[Any, Any, Any], **options: Any) -> Any:
        async def to_the_end() -> Any:
            try:
                return await main
            finally:
                left.extend(
                    f"task {task.get_coro()!r}"
                    for task in asyncio.all_tasks() - {asyncio.current_task()}
                    if not task.done()
                )

        return run(to_the_end(), **options)

    monkeypatch.setattr(asyncio, "run", watched)
    return left


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8", "replace")
    except OSError:
        return ""
