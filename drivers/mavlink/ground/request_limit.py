"""Rate limits of requests: per sender, and for all senders together."""

from __future__ import annotations

from collections import OrderedDict

from drivers.mavlink.wire.send_queue import RateLimit

EACH_HZ, EACH_BURST = 40.0, 120.0
ALL_HZ, ALL_BURST = 160.0, 300.0
MOST_ASKERS = 32


class RequestLimit:
    """Rate limit of requests, without a clock; `now_ns` is any monotonic time."""

    def __init__(self) -> None:
        self.n_refused = 0
        self._all = RateLimit(ALL_HZ, ALL_BURST)
        self._askers: OrderedDict[tuple[int, int], RateLimit] = OrderedDict()

    def allows(self, asker: tuple[int, int], now_ns: int) -> bool:
        """True if a request is accepted; rejected ones are counted."""
        own = self._askers.get(asker)
        if own is None:
            own = self._askers[asker] = RateLimit(EACH_HZ, EACH_BURST)
            while len(self._askers) > MOST_ASKERS:
                self._askers.popitem(last=False)
        self._askers.move_to_end(asker)
        for limit in (own, self._all):
            limit.refill(now_ns)
        if own.left < 1.0 or self._all.left < 1.0:
            self.n_refused += 1
            return False
        own.take(1.0)
        self._all.take(1.0)
        return True
