"""Newest items of a flight, encoded for the wire, in bounded memory.

It holds what a viewer that connects now must be given. Points are nearly all of it; beyond the
capacity the finest of the oldest are evicted, counted.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Hashable, Iterable
from typing import Protocol

from companion.streaming.item_codec import Kind
from companion.streaming.items import FlightItem, ImageItem, Item, StatusItem
from companion.streaming.parts import NEWEST, Part

MOST_LOG_LINES = 200
MOST_PIECES = 20_000


class StoreListener(Protocol):
    """Notified of new items."""

    def changed(self, kind: Kind, key: Hashable) -> None:
        """There is a new item of a kind."""


class ItemStore:
    """Takes items, and notifies its listeners. To be used by one thread at a time."""

    def __init__(self, available_bytes: int) -> None:
        self._capacity_bytes = available_bytes
        self._held: dict[Kind, OrderedDict[Hashable, bytes]] = {k: OrderedDict() for k in Kind}
        self._n_logged = 0
        self.points_bytes = 0
        self.image: ImageItem | None = None
        self.flight: FlightItem | None = None
        self.status: StatusItem | None = None
        self.n_evicted: Counter[str] = Counter()
        """Evicted items, by kind."""
        self._listeners: list[StoreListener] = []

    def subscribe(self, listener: StoreListener) -> None:
        """Notify a listener of all items, oldest first, and of new ones from now on."""
        self._listeners.append(listener)
        for kind, held in self._held.items():
            for key in held:
                listener.changed(kind, key)
        if self.image is not None:
            listener.changed(Kind.PICTURE, NEWEST)
        if self.status is not None:
            listener.changed(Kind.STATUS, NEWEST)

    def unsubscribe(self, listener: StoreListener) -> None:
        """Notify a listener no more."""
        self._listeners.remove(listener)

    def get(self, kind: Kind, key: Hashable) -> bytes | None:
        """Payload of an item; None where it was evicted."""
        return self._held[kind].get(key)

    def put(self, item: Item, parts: Iterable[Part]) -> None:
        """Keep an item, encoded already as `parts`; replaces an older one with the same key."""
        if isinstance(item, ImageItem):
            self.image = item
            self._tell(Kind.PICTURE, NEWEST)
        elif isinstance(item, StatusItem):
            self.status = item
            self._tell(Kind.STATUS, NEWEST)
        elif isinstance(item, FlightItem):
            self.flight = item
        for kind, key, payload in parts:
            if kind is Kind.LOG:
                self._n_logged += 1
                key = self._n_logged
            self._hold(kind, key, payload)
        for kind, most in ((Kind.LOG, MOST_LOG_LINES), (Kind.PATH, MOST_PIECES),
                           (Kind.AUTOPILOT, MOST_PIECES)):  # fmt: skip
            while len(self._held[kind]) > most:
                self._evict_oldest(kind)
        for kind in (Kind.FINE, Kind.COARSE):
            while self.points_bytes > self._capacity_bytes and self._held[kind]:
                self._evict_oldest(kind)

    def _hold(self, kind: Kind, key: Hashable, payload: bytes) -> None:
        before = self._held[kind].pop(key, b"")  # so that the newest is the last
        self._held[kind][key] = payload
        if kind in (Kind.COARSE, Kind.FINE):
            self.points_bytes += len(payload) - len(before)
        self._tell(kind, key)

    def _evict_oldest(self, kind: Kind) -> None:
        _, payload = self._held[kind].popitem(last=False)
        if kind in (Kind.COARSE, Kind.FINE):
            self.points_bytes -= len(payload)
        self.n_evicted[kind.name.lower()] += 1

    def _tell(self, kind: Kind, key: Hashable) -> None:
        for listener in self._listeners:
            listener.changed(kind, key)
