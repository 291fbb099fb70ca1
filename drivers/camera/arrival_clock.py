"""Exposure times of network cameras: the sender's stamps on our clock."""

from __future__ import annotations

MAX_DRIFT = 200e-6
"""Largest drift between two computers' clocks."""
MAX_LATE_NS = 1_000_000_000
SETTLED_FALL_NS, SETTLED_AFTER = 5_000_000, 5
"""Number of arrivals not much earlier than the estimate that show the end of a backlog."""
STEPPED_AFTER_NS = 3_000_000_000
"""Lateness that lasts longer is a step of the sender's clock."""


class ArrivalClock:
    """Offset of the sender's clock by the least delayed arrivals: a delay only makes an image late.

    The delay common to all images (encoding, the network at its best) is not observable; that is
    what `expert.camera.stamp_offset_ms` is for.
    """

    def __init__(self) -> None:
        self._offset_ns: float | None = None
        self._last_ns = 0
        self._late_since_ns: int | None = None
        self._n_steady = 0

    @property
    def settled(self) -> bool:
        """True once times are valid: images buffered before the connection arrive all at once."""
        return self._n_steady >= SETTLED_AFTER

    def monotonic_ns(self, sent_ns: int, arrived_ns: int) -> int:
        """CLOCK_MONOTONIC of the sender's stamp `sent_ns`; never later than the arrival."""
        offset_ns = float(arrived_ns - sent_ns)
        if self._offset_ns is None or self._stepped_back(offset_ns, arrived_ns):
            self._offset_ns, self._n_steady = offset_ns, 0
        if not self.settled:
            fallen = self._offset_ns - offset_ns > SETTLED_FALL_NS
            self._n_steady = 0 if fallen else self._n_steady + 1
        risen_ns = self._offset_ns + MAX_DRIFT * max(0, arrived_ns - self._last_ns)
        self._offset_ns = min(offset_ns, risen_ns)
        self._last_ns = arrived_ns
        return round(sent_ns + self._offset_ns)

    def _stepped_back(self, offset_ns: float, arrived_ns: int) -> bool:
        assert self._offset_ns is not None
        if offset_ns - self._offset_ns < MAX_LATE_NS:
            self._late_since_ns = None
            return False
        if self._late_since_ns is None:
            self._late_since_ns = arrived_ns
        if arrived_ns - self._late_since_ns < STEPPED_AFTER_NS:
            return False
        self._late_since_ns = None
        return True
