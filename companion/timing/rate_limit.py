"""Rate limits as token buckets, for one or for many peers; they ask no clock."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable


class RateLimit:
    """Token bucket of `per_s` tokens a second, up to `burst`; `left` below zero is a debt."""

    def __init__(self, per_s: float, burst: float) -> None:
        self.per_s = per_s
        self.burst = burst
        self.left = burst
        self._last_ns = 0

    def refill(self, now_ns: int) -> None:
        """Add the tokens since the last call; `now_ns` is any monotonic time."""
        gained = (now_ns - self._last_ns) * 1e-9 * self.per_s
        self.left = min(self.burst, self.left + max(0.0, gained))
        self._last_ns = now_ns

    def take(self, n: float) -> None:
        """Use tokens, available or not."""
        self.left -= n

    def wait_s(self, wanted: float = 0.0) -> float:
        """Seconds until this many are available."""
        return max(0.0, (wanted - self.left) / self.per_s)


class PeerLimit:
    """Limit of requests: `each` of a peer and `together` of all, as tokens a second and burst.

    Of more than `most_peers` the one that has not asked for longest is forgotten.
    """

    def __init__(
        self, each: tuple[float, float], together: tuple[float, float], most_peers: int
    ) -> None:
        self.n_refused = 0
        self._each, self._together, self._most = each, RateLimit(*together), most_peers
        self._peers: OrderedDict[Hashable, RateLimit] = OrderedDict()

    def allows(self, peer: Hashable, now_ns: int) -> bool:
        """True if a request is within both rates, and counts from now on."""
        own = self._peers.pop(peer, None) or RateLimit(*self._each)
        self._peers[peer] = own
        if len(self._peers) > self._most:
            self._peers.popitem(last=False)
        for limit in (own, self._together):
            limit.refill(now_ns)
        if own.left < 1.0 or self._together.left < 1.0:
            self.n_refused += 1
            return False
        own.take(1.0)
        self._together.take(1.0)
        return True
