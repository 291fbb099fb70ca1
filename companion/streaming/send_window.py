"""Congestion window to a viewer: as many bytes in flight as the link carries without queueing.

A window of unacknowledged bytes. It grows while it limits the sender and the standing delay (the
least recent round trip) stays near the base round trip; it shrinks when the standing delay shows a
queue. Losses, which TCP repairs, delay some acknowledgements but not all, and so do not shrink it.
After Arun and Balakrishnan, Copa (NSDI 2018), for the standing delay, and LEDBAT (RFC 6817), for
the target.
"""

from __future__ import annotations

from collections import deque

LEAST_BYTES = 6_000
MOST_BYTES = 4 << 20
LEAST_USED = 1_000
"""Less than this is not used: a piece would be too small."""
QUEUE_S = 0.05
"""Delay above the base round trip that counts as a queue."""
STANDING_S = 0.1
"""Window of the standing delay, or two round trips if that is longer: a retransmission delays all
that follows by one."""
FORGET_S = 20.0
"""Time window of the base round trip."""
BASE_RISE_S = 0.005
"""A rise of the base round trip by more may include our own queue, on a link that is always full.
Then at most LEAST_BYTES are in flight for a round trip, to measure it anew."""
SHRINK = 0.8
RATE_OVER_S = 1.0


class SendWindow:
    """Counts bytes sent and acknowledged; times are seconds of one monotonic clock."""

    def __init__(self) -> None:
        self.size_bytes = float(LEAST_BYTES)
        self.sent_bytes = 0
        self.acknowledged_bytes = 0
        self.round_trip_s: float | None = None
        """The newest; None before any."""
        self._in_flight: deque[tuple[int, float]] = deque()
        self._base: list[tuple[float, float]] = []
        self._standing: deque[tuple[float, float]] = deque()
        self._delivered: deque[tuple[float, int]] = deque()
        self._limited_at = -1
        """Bytes sent when the window was last full; their acknowledgement shows that it limits."""
        self._shrunk_s = -1e9
        self._has_seen_queue = False
        self._drains_from: int | None = None
        """Bytes sent before the base round trip began to be measured anew; None otherwise."""

    @property
    def in_flight_bytes(self) -> int:
        """Bytes sent and not yet acknowledged."""
        return self.sent_bytes - self.acknowledged_bytes

    def available_bytes(self) -> int:
        """Bytes that may be sent now."""
        drains = self._drains_from is not None
        capacity = (LEAST_BYTES if drains else int(self.size_bytes)) - self.in_flight_bytes
        if capacity < LEAST_USED and not drains:
            self._limited_at = self.sent_bytes
        return max(0, capacity)

    def sent(self, now_s: float, n_bytes: int) -> None:
        """Count bytes sent."""
        self.sent_bytes += n_bytes
        self._in_flight.append((self.sent_bytes, now_s))

    def acknowledged(self, now_s: float, total_bytes: int) -> None:
        """Take the total of bytes acknowledged by the viewer."""
        if not self.acknowledged_bytes < total_bytes <= self.sent_bytes:
            return
        n_new, self.acknowledged_bytes = total_bytes - self.acknowledged_bytes, total_bytes
        went_s = None
        while self._in_flight and self._in_flight[0][0] <= total_bytes:
            went_s = self._in_flight.popleft()[1]
        self._delivered.append((now_s, total_bytes))
        while self._delivered[0][0] < now_s - RATE_OVER_S and len(self._delivered) > 2:
            self._delivered.popleft()
        if went_s is None:
            return
        if self._drains_from is not None and total_bytes > self._drains_from:
            self._drains_from = None
        self.round_trip_s = now_s - went_s
        self._adjust(now_s, self.round_trip_s, n_new)

    @property
    def rate_bytes_s(self) -> float:
        """Recent goodput; 0 before any acknowledgement."""
        if len(self._delivered) < 2:
            return 0.0
        (t0, n0), (t1, n1) = self._delivered[0], self._delivered[-1]
        return (n1 - n0) / max(t1 - t0, 0.05)

    @property
    def capacity_bytes_s(self) -> float:
        """Capacity of the link, by window and round trip; 0 while unknown."""
        if self.round_trip_s is None or not self._base:
            return 0.0
        return self.size_bytes / max(min(r for _, r in self._base) + QUEUE_S / 2, 1e-3)

    def _adjust(self, now_s: float, round_trip_s: float, n_new: int) -> None:
        base_s = self._base_s(now_s, round_trip_s)
        self._standing.append((now_s, round_trip_s))
        while self._standing[0][0] < now_s - max(STANDING_S, 2 * base_s):
            self._standing.popleft()
        queue_s = min(r for _, r in self._standing) - base_s
        if queue_s > QUEUE_S:
            self._has_seen_queue = True
            if now_s - self._shrunk_s > max(STANDING_S, round_trip_s):
                self._shrunk_s = now_s
                self.size_bytes = max(LEAST_BYTES, self.size_bytes * SHRINK)
        elif self.acknowledged_bytes <= self._limited_at:
            gain = 0.25 if self._has_seen_queue else 1.0
            self.size_bytes = min(MOST_BYTES, self.size_bytes + gain * n_new)

    def _base_s(self, now_s: float, round_trip_s: float) -> float:
        """Base round trip: the least of two windows of time, of which the older expires."""
        if not self._base or now_s - self._base[-1][0] > FORGET_S:
            if self._base and self._base[-1][1] > self._base[0][1] + BASE_RISE_S:
                self._drains_from = self.sent_bytes
            self._base = [*self._base[-1:], (now_s, round_trip_s)]
        elif round_trip_s < self._base[-1][1]:
            self._base[-1] = (self._base[-1][0], round_trip_s)
        return min(r for _, r in self._base)


class TokenBucket:
    """Token bucket: fills at a rate, 0 for no limit; may be overdrawn by one piece."""

    def __init__(self, kbit_s: float) -> None:
        self.bytes_s = kbit_s * 125.0
        self._held = 0.0
        self._t_s: float | None = None

    def set_rate(self, kbit_s: float) -> None:
        """Change the rate."""
        self.bytes_s = kbit_s * 125.0

    def available_bytes(self, now_s: float) -> int:
        """Bytes that may be sent now."""
        if self.bytes_s <= 0:
            return MOST_BYTES
        if self._t_s is not None:
            self._held += (now_s - self._t_s) * self.bytes_s
        self._t_s = now_s
        self._held = min(self._held, max(0.05 * self.bytes_s, 3000.0))
        return max(0, int(self._held))

    def charge(self, n_bytes: int) -> None:
        """Count bytes sent."""
        self._held -= n_bytes
