"""Rates of requests: a bucket of tokens for each peer, and one for all together."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

MOST_PEERS = 256
"""Peers that are remembered; the one that has not asked for longest is forgotten."""


@dataclass(slots=True)
class _Bucket:
    tokens: float
    at_s: float


class TokenBuckets:
    """`burst` requests at once and `rate_hz` on average; `clock` gives seconds."""

    def __init__(self, rate_hz: float, burst: float, clock: Callable[[], float]) -> None:
        self._rate_hz, self._burst, self._clock = rate_hz, burst, clock
        self._buckets: OrderedDict[str, _Bucket] = OrderedDict()

    def take(self, peer: str) -> bool:
        """True if a request of a peer is within its rate, and counts from now on."""
        now_s = self._clock()
        bucket = self._buckets.get(peer)
        if bucket is None:
            if len(self._buckets) >= MOST_PEERS:
                self._buckets.popitem(last=False)
            bucket = self._buckets[peer] = _Bucket(self._burst, now_s)
        self._buckets.move_to_end(peer)
        grown = bucket.tokens + (now_s - bucket.at_s) * self._rate_hz
        bucket.tokens, bucket.at_s = min(grown, self._burst), now_s
        if bucket.tokens < 1.0:
            return False
        bucket.tokens -= 1.0
        return True
