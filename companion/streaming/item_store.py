"""The newest of everything there is to see, ready for the wire. Bounded, whatever the flight.

What is kept is what a viewer that comes now must be given. The points are nearly all of it; when
they are more than there is room for, the finest of the oldest go first, counted.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Hashable, Iterable
from typing import Protocol

from companion.streaming.item_codec import Kind
from companion.streaming.items import FlightItem, ImageItem, Item, StatusItem
from companion.streaming.parts import NEWEST, Part, parts_of

MOST_LOG_LINES = 200
MOST_PIECES = 20_000


class StoreListener(Protocol):
    """Who hears of what is new."""

    def changed(self, kind: Kind, key: Hashable) -> None:
        """There is a new one of a kind."""


class ItemStore:
    """Takes items, and tells its followers. To be used by one thread at a time."""

    def __init__(self, available_bytes: int) -> None:
        self._capacity_bytes = available_bytes
        self._held: dict[Kind, OrderedDict[Hashable, bytes]] = {k: OrderedDict() for k in Kind}
        self._n_logged = 0
        self.points_bytes = 0
        self.image: ImageItem | None = None
        self.flight: FlightItem | None = None
        self.status: StatusItem | None = None
        self.n_evicted: Counter[str] = Counter()
        """What there was no room for, by what it was."""
        self._listeners: list[StoreListener] = []

    def subscribe(self, follower: StoreListener) -> None:
        """Have somebody told of all there is, oldest first, and from now on of all that is new."""
        self._listeners.append(follower)
        for kind, held in self._held.items():
            for key in held:
                follower.changed(kind, key)
        if self.image is not None:
            follower.changed(Kind.PICTURE, NEWEST)
        if self.status is not None:
            follower.changed(Kind.STATUS, NEWEST)

    def unsubscribe(self, follower: StoreListener) -> None:
        """Somebody is told nothing any more."""
        self._listeners.remove(follower)

    def get(self, kind: Kind, key: Hashable) -> bytes | None:
        """What there is now; None where it was given up."""
        return self._held[kind].get(key)

    def take(self, item: Item) -> None:
        """Keep an item in the place of an older one of the same thing."""
        self.put(item, parts_of(item))

    def put(self, item: Item, parts: Iterable[Part]) -> None:
        """The same, with the item's parts made already: to make them takes time."""
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
        for follower in self._listeners:
            follower.changed(kind, key)
