"""Measurements of one kind that the innovation gate refuses in a row."""

from __future__ import annotations


class RefusedRun:
    """A run of refused measurements, none of which is further than `longest_gap_ns` from the next.

    Where nothing was measured for longer than that, nothing tells whether it would have been
    refused: a run of outliers before the gap, and one after it, are two.
    """

    def __init__(self, longest_gap_ns: int) -> None:
        self._longest_gap_ns = longest_gap_ns
        self._first_ns: int | None = None
        self._newest_ns = 0

    @property
    def repeated(self) -> bool:
        """True once it is of two or more."""
        return self._first_ns is not None and self._newest_ns > self._first_ns

    def refuse(self, t_ns: int) -> int:
        """Add a measurement that was refused; the run's duration, nanoseconds."""
        if self._first_ns is None or t_ns - self._newest_ns > self._longest_gap_ns:
            self._first_ns = t_ns
        self._newest_ns = t_ns
        return t_ns - self._first_ns

    def end(self) -> None:
        """End the run: one was accepted, or what refused them has changed."""
        self._first_ns = None
