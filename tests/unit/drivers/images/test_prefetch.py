from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from drivers.images.prefetch import Prefetch


class Source:
    def __init__(self, fail_at: int | None = None) -> None:
        self.made = 0
        self.closed = threading.Event()
        self._fail_at = fail_at

    def items(self) -> Iterator[int]:
        try:
            for number in range(100):
                if number == self._fail_at:
                    raise ValueError("broken")
                self.made += 1
                yield number
        finally:
            self.closed.set()


def test_order_is_kept() -> None:
    assert list(Prefetch(Source().items(), 3)) == list(range(100))


def test_no_more_is_made_than_was_asked_for() -> None:
    source = Source()
    prefetch = Prefetch(source.items(), 3)
    taken = [number for number, _ in zip(prefetch, range(5), strict=False)]
    prefetch.close()
    assert taken == [0, 1, 2, 3, 4]
    assert source.made <= 5 + 3 + 2
    assert source.closed.is_set()


def test_an_error_comes_where_its_item_would() -> None:
    taken = []
    with pytest.raises(ValueError, match="broken"):
        for number in Prefetch(Source(fail_at=4).items(), 2):
            taken.append(number)
    assert taken == [0, 1, 2, 3]


def test_closing_what_nobody_read() -> None:
    source = Source()
    Prefetch(source.items(), 2).close()
    assert source.closed.is_set()
