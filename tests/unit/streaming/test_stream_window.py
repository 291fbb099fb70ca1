from __future__ import annotations

from collections import deque

import pytest

from companion.streaming.send_window import LEAST_BYTES, MOST_BYTES, SendWindow, TokenBucket


class Sender:
    """Sends as much as there is room for; what has come is acknowledged each 10 ms."""

    def __init__(self) -> None:
        self.window, self.now_s = SendWindow(), 0.0
        self._on_way: list[tuple[float, int]] = []

    def run(self, round_trips_s: list[float]) -> float:
        """Go on, each 10 ms with another round trip; the window's size."""
        for round_trip_s in round_trips_s:
            while room := self.window.available_bytes() // 500 * 500:
                self.window.sent(self.now_s, min(room, 1000))
                self._on_way.append((self.now_s + round_trip_s, self.window.sent_bytes))
            self.now_s += 0.01
            for at_s, total in [each for each in self._on_way if each[0] <= self.now_s]:
                self.window.acknowledged(self.now_s, total)
                self._on_way.remove((at_s, total))
        return self.window.size_bytes


def test_it_opens_while_it_is_the_limit_and_no_delay_is_added() -> None:
    assert 20 * LEAST_BYTES < Sender().run([0.05] * 40) <= MOST_BYTES


def test_it_closes_when_all_is_delayed_but_not_when_some_is() -> None:
    queued, repaired = Sender(), Sender()
    open_bytes = queued.run([0.05] * 25)
    assert queued.run([0.35] * 600) < 0.5 * open_bytes
    repaired.run([0.05] * 25)
    assert repaired.run([0.05, 0.15, 0.05, 0.05] * 10) >= open_bytes


def test_a_link_that_is_always_full_has_no_queue_that_grows() -> None:
    window, now_s, free_s = SendWindow(), 0.0, 0.0
    bytes_s, round_trip_s = 2.5e6, 0.02
    on_way: deque[tuple[float, int]] = deque()
    queued_s = []
    while now_s < 120.0:
        now_s += 0.002
        while (room := window.available_bytes()) >= 1000:
            piece = min(room, 5000)
            window.sent(now_s, piece)
            free_s = max(free_s, now_s) + piece / bytes_s
            on_way.append((free_s + round_trip_s, window.sent_bytes))
        while on_way and on_way[0][0] <= now_s:
            window.acknowledged(now_s, on_way.popleft()[1])
        queued_s.append(max(0.0, free_s - now_s))
    late = queued_s[len(queued_s) // 2 :]
    assert max(late) < 0.2
    assert window.sent_bytes > 0.93 * 120.0 * bytes_s  # and it is full all the same


def test_what_was_never_sent_or_is_old_is_no_acknowledgement() -> None:
    window = SendWindow()
    window.sent(0.0, 1000)
    window.acknowledged(0.1, 5000)
    assert window.in_flight_bytes == 1000
    window.acknowledged(0.2, 600)
    window.acknowledged(0.3, 500)
    assert window.in_flight_bytes == 400 and window.round_trip_s is None
    window.acknowledged(0.4, 1000)
    assert window.round_trip_s == pytest.approx(0.4)


def test_a_budget_fills_at_its_rate_and_holds_little() -> None:
    budget = TokenBucket(800)  # 100 kB/s
    assert budget.available_bytes(0.0) == 0
    assert budget.available_bytes(0.01) == 1000
    assert budget.available_bytes(100.0) == 5000
    budget.charge(7000)
    assert budget.available_bytes(100.01) == 0
    assert budget.available_bytes(100.04) == 2000
    assert TokenBucket(0).available_bytes(5.0) >= MOST_BYTES
