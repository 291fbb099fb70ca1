"""Ticks of the event loop: those of several tasks come together."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from drivers.system.ticks import tick


class PassingLoop(asyncio.SelectorEventLoop):
    """An event loop whose time passes at once, and `late_s` more at each wake-up."""

    now_s, late_s = 1000.0137, 0.0004

    def time(self) -> float:
        return self.now_s

    def _run_once(self) -> None:
        waiting: Any = self
        if waiting._scheduled and not waiting._ready:
            self.now_s = max(self.now_s, waiting._scheduled[0].when()) + self.late_s
        super()._run_once()  # type: ignore[misc]


def woken(*periods_s: float) -> list[list[tuple[float, float]]]:
    """Times at which tasks of these periods woke up, begun 3 ms apart, and how late each was."""

    async def ticking(begin_s: float, period_s: float) -> list[tuple[float, float]]:
        loop = asyncio.get_running_loop()
        await asyncio.sleep(begin_s)
        out = []
        for _ in range(round(1.0 / period_s)):
            late_s = await tick(period_s)
            out.append((loop.time(), late_s))
        return out

    async def all_of_them() -> list[list[tuple[float, float]]]:
        begun = enumerate(periods_s)
        return await asyncio.gather(*(ticking(0.003 * n, each) for n, each in begun))

    loop = PassingLoop()
    try:
        return loop.run_until_complete(all_of_them())
    finally:
        loop.close()


def test_tasks_of_one_period_wake_up_together() -> None:
    first, second, third = woken(0.05, 0.05, 0.05)
    assert {t_s for t_s, _ in first} == {t_s for t_s, _ in second} == {t_s for t_s, _ in third}


def test_a_longer_period_wakes_the_loop_at_no_time_of_its_own() -> None:
    often, seldom = woken(0.05, 0.1)
    ends_s = often[-1][0]
    assert {t_s for t_s, _ in seldom if t_s <= ends_s} == {t_s for t_s, _ in often[1::2]}


def test_a_tick_tells_by_how_much_the_loop_was_late() -> None:
    for t_s, late_s in woken(0.05)[0]:
        assert late_s == pytest.approx(t_s % 0.05, abs=1e-6)
        assert late_s == pytest.approx(PassingLoop.late_s, abs=1e-6)
