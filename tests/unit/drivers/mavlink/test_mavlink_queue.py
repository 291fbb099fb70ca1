from __future__ import annotations

import pytest

from companion.timing.rate_limit import RateLimit
from drivers.mavlink.wire.send_queue import PacketQueue

S = 10**9


def test_the_oldest_are_given_up() -> None:
    queue = PacketQueue(30)
    for i in range(10):
        queue.push(bytes([i]) * 10)
    assert [queue.pop()[0] for _ in range(len(queue))] == [7, 8, 9]
    assert (queue.n_dropped, queue.n_bytes) == (7, 0)


def test_a_packet_begun_is_ended_whatever_is_given_up() -> None:
    queue = PacketQueue(30)
    queue.push(b"a" * 10)
    queue.written(4)
    for letter in b"bcde":
        queue.push(bytes([letter]) * 10)
    assert queue.n_dropped == 2
    assert [queue.pop() for _ in range(len(queue))] == [b"a" * 6, b"d" * 10, b"e" * 10]
    assert queue.n_bytes == 0


def test_the_newest_is_kept_even_if_it_is_too_large() -> None:
    queue = PacketQueue(5)
    queue.push(b"a" * 10)
    queue.push(b"b" * 10)
    assert (queue.head(), len(queue), queue.n_dropped) == (b"b" * 10, 1, 1)


def test_what_is_cleared_counts_as_dropped() -> None:
    queue = PacketQueue(100)
    queue.push(b"abc")
    queue.written(1)
    queue.push(b"def")
    queue.clear()
    queue.push(b"ghi")
    queue.push(b"jkl")
    assert (queue.n_dropped, queue.n_bytes, queue.head()) == (2, 6, b"ghi")


def test_a_rate_is_kept() -> None:
    limit = RateLimit(1000, 200)
    used = 0
    for t_ns in range(0, 10 * S, S // 100):
        limit.refill(t_ns)
        if limit.left > 0:
            limit.take(50)
            used += 50
    assert used == pytest.approx(10_000 + 200, abs=60)
    limit.take(1000)
    assert limit.wait_s() == pytest.approx(-limit.left / 1000)
