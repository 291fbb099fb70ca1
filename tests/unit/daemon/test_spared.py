"""A fault in a part that the pose can do without ends that part alone."""

from __future__ import annotations

import asyncio

import pytest

from companion.daemon.spared import FAILED, spared


async def test_a_fault_is_told_with_its_place_and_ends_nothing_else() -> None:
    told: list[tuple[str, str]] = []

    async def page() -> None:
        raise ZeroDivisionError

    await spared("page", page(), lambda what, detail: told.append((what, detail)))
    assert [what for what, _ in told] == [FAILED]
    assert told[0][1].startswith("page: ") and "test_spared.py" in told[0][1]


async def test_it_ends_by_cancellation() -> None:
    task = asyncio.create_task(spared("page", asyncio.Event().wait(), pytest.fail))  # type: ignore[arg-type]
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
