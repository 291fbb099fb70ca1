"""Bundles that wait to be fetched; the oldest are evicted when capacity is short.

Stateless for clients: each states what it has, so that clients may vanish, come back, and begin
anew.
"""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

import numpy as np

from companion.messages import MapUpdate
from companion.timing.rate_limit import RateLimit
from companion.topics.envelope import Envelope
from companion.topics.keyframe_bundle import Bundle, MapChange

SAVED_S = 2.0
"""Seconds of unused budget that are kept."""


@dataclass(frozen=True, slots=True)
class _Held:
    number: int
    data: bytes


class Backlog:
    """Bundles of one flight for nodes that fetch them; thread-safe. A budget of 0 is no limit."""

    def __init__(self, run: str, capacity_bytes: int, budget_bytes_s: float) -> None:
        self._run, self._capacity_bytes = run, capacity_bytes
        self._budget = RateLimit(budget_bytes_s, SAVED_S * budget_bytes_s)
        self._held: deque[_Held] = deque()
        self._n_bytes = 0
        self._map: MapUpdate | None = None
        self._lock = threading.Lock()
        self.n_evicted = 0
        """Bundles evicted before anybody had fetched them."""
        self.fetched = -1
        """Newest bundle fetched."""
        self.newest = -1
        self.fetched_s = float("-inf")
        """Time of the last query."""

    def put(self, bundle: Bundle, update: MapUpdate | None) -> None:
        """Add a bundle; `update` is the whole map after it."""
        held = _Held(bundle.number, bundle.pack())
        with self._lock:
            self._held.append(held)
            self._n_bytes += len(held.data)
            self.newest = held.number
            self._map = update
            while self._n_bytes > self._capacity_bytes and len(self._held) > 1:
                oldest = self._held.popleft()
                self._n_bytes -= len(oldest.data)
                self.n_evicted += oldest.number > self.fetched

    def after(self, run: str, number: int, now_s: float, whole: bool = False) -> bytes:
        """Bytes of the bundle after bundle `number` of a run, or `wait` where none may go.

        Where bundles between are gone, or with `whole`, the whole map comes first, in a bundle that
        has the number before. The number of another run counts for nothing: then the oldest
        follows.
        """
        with self._lock:
            self.fetched_s = now_s
            if run != self._run:
                number = -1
            self.fetched = max(self.fetched, number)
            found = next((held for held in self._held if held.number > number), None)
            if found is None or not self._may(now_s):
                return self._wait()
            if self._map is not None and (whole or found.number > number + 1):
                change = MapChange(_without_points(self._map), (), True)
                data = Bundle(self._run, found.number - 1, change=change).pack()
            else:
                data = found.data
            self._budget.take(len(data))
            return data

    def _may(self, now_s: float) -> bool:
        self._budget.refill(round(now_s * 1e9))
        return not self._budget.per_s or self._budget.left > 0

    def _wait(self) -> bytes:
        return Envelope("wait", {"run": self._run, "newest": self.newest}, {}).pack()


def _without_points(update: MapUpdate) -> MapUpdate:
    return MapUpdate(
        update.revision, update.t_ns, update.map_from_camera, np.zeros((0, 3)),
        update.georeference, update.scale_of, update.n_retired,
    )  # fmt: skip
