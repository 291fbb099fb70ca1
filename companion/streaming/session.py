"""Scheduler of the items that one viewer is sent.

Pose and state come first, then the map from coarse to fine, then pictures; of anything that the
link has no time for only the newest waits.

Nothing here waits or grows: the queues hold keys of items in the store.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Hashable
from dataclasses import dataclass, replace

from companion.streaming.frame_jpeg import AdaptiveJpeg
from companion.streaming.framing import HEAD_BYTES, frame
from companion.streaming.item_codec import Kind, encode
from companion.streaming.item_store import ItemStore
from companion.streaming.parts import NEWEST
from companion.streaming.send_window import SendWindow

ORDER = (
    Kind.FLIGHT, Kind.POSE, Kind.STATUS, Kind.OBSTACLES, Kind.LOG, Kind.PLACES, Kind.PATH,
    Kind.AUTOPILOT, Kind.COARSE, Kind.FINE, Kind.PICTURE, Kind.DEPTH,
)  # fmt: skip
PICTURES = (Kind.PICTURE, Kind.DEPTH)
PICTURE_SHARE = 0.15
"""Share of the rate for pictures until the map is complete; then they get the rest."""
MOST_CREDIT_BYTES = 20_000
POSE_SHARE, POSE_BYTES = 0.15, 120
OBSTACLES_SHARE, OBSTACLES_BYTES = 0.05, 900
MOST_POSES_HZ, LEAST_POSES_HZ = 30.0, 2.0
POSES_BESIDE_HZ = 2.0
"""Rate of poses on the connection where datagrams get through."""
STATUS_EVERY_S, ALIVE_EVERY_S = 1.0, 0.5
PICTURES_HZ, OBSTACLES_HZ = 15.0, 10.0
PLACES_AT_ONCE = 40
PIECE_S = 0.02
LEAST_PIECE, MOST_PIECE = 1000, 16_000
ASSUMED_BYTES_S = 30_000.0
"""Initial rate."""
Keys = list[Hashable]


@dataclass(slots=True)
class _Partial:
    """An item that is partly sent."""

    keys: Keys
    payload: bytes
    at: int = 0


class Session:
    """One viewer, over all of its connections; times are seconds of one monotonic clock."""

    def __init__(self, store: ItemStore) -> None:
        self._store = store
        self.window = SendWindow()
        self._waiting: dict[Kind, dict[Hashable, None]] = {kind: {} for kind in ORDER}
        self._partial: dict[Kind, _Partial] = {}
        self._in_flight: deque[tuple[int, Kind, Keys]] = deque()
        self._sent_s = dict.fromkeys((*ORDER, None), -1e9)
        self._pictures = AdaptiveJpeg()
        self._credit = 0.0
        self.is_connected = True
        """True while the viewer is connected: skipped items are counted."""
        self._pose_is_new = False
        self._datagram_s = -1e9
        self.datagrams_work = False
        """True while poses get through by datagram."""
        self.limit_bytes_s = 0.0
        """Rate limit of this viewer; 0 for none."""
        self.n_skipped: Counter[str] = Counter()
        """Poses and pictures replaced by newer ones."""
        self.n_sent: Counter[str] = Counter()
        """Bytes, by kind."""
        store.subscribe(self)

    def changed(self, kind: Kind, key: Hashable) -> None:
        """There is a new item of a kind."""
        waiting = self._waiting[kind]
        if kind is Kind.POSE:
            self.n_skipped["poses"] += self._pose_is_new and self.is_connected
            self._pose_is_new = True
        elif kind is Kind.PICTURE:
            self.n_skipped["pictures"] += key in waiting and self.is_connected
        waiting.pop(key, None)  # so that the newest is the last
        waiting[key] = None

    def reconnected(self) -> None:
        """A new connection: unacknowledged items of the one before are sent again."""
        for _, kind, keys in self._in_flight:
            self._queue_again(kind, keys)
        for kind, partial in self._partial.items():
            self._queue_again(kind, partial.keys)
        self._in_flight.clear()
        self._partial.clear()
        self.window = SendWindow()
        self._sent_s = dict.fromkeys(self._sent_s, -1e9)
        self.changed(Kind.FLIGHT, NEWEST)

    def acknowledged(self, now_s: float, total_bytes: int) -> None:
        """Take the total of bytes acknowledged on this connection."""
        self.window.acknowledged(now_s, total_bytes)
        while self._in_flight and self._in_flight[0][0] <= self.window.acknowledged_bytes:
            self._in_flight.popleft()

    @property
    def rate_bytes_s(self) -> float:
        """Estimated rate of the link for this viewer."""
        rate = self.window.capacity_bytes_s or ASSUMED_BYTES_S
        return min(rate, self.limit_bytes_s) if self.limit_bytes_s > 0 else rate

    @property
    def n_waiting(self) -> int:
        """Number of map items not yet sent."""
        return sum(len(self._waiting[kind]) for kind in ORDER[4:-2])

    @property
    def is_complete(self) -> bool:
        """True if everything has been received."""
        return not self._in_flight and not self._partial and not any(self._waiting.values())

    def next_datagram(self, now_s: float) -> bytes | None:
        """The newest pose, if due and not sent yet."""
        every_s = self._pose_every_s() if self.datagrams_work else 1.0 / POSES_BESIDE_HZ
        if not self._pose_is_new or now_s - self._datagram_s < every_s:
            return None
        self._pose_is_new, self._datagram_s = False, now_s
        payload = self._store.get(Kind.POSE, NEWEST)
        return bytes([Kind.POSE]) + payload if payload is not None else None

    def next_piece(self, now_s: float, most_bytes: int) -> bytes | None:
        """Next piece to send, framed; None if there is none now, or no capacity."""
        rate = self.rate_bytes_s
        most = int(min(max(rate * PIECE_S, LEAST_PIECE), MOST_PIECE, most_bytes - HEAD_BYTES))
        if most < min(LEAST_PIECE, MOST_PIECE) // 4:
            return None
        kind = self._next_kind(now_s, rate)
        if kind is None:
            if now_s - self._sent_s[None] < ALIVE_EVERY_S:
                return None
            return self._sent(now_s, None, frame(0, b"", True))
        partial = self._partial[kind]
        piece = partial.payload[partial.at : partial.at + most]
        partial.at += len(piece)
        is_last = partial.at >= len(partial.payload)
        framed = self._sent(now_s, kind, frame(kind, piece, is_last))
        if is_last:
            del self._partial[kind]
            self._in_flight.append((self.window.sent_bytes, kind, partial.keys))
        return framed

    def _sent(self, now_s: float, kind: Kind | None, framed: bytes) -> bytes:
        self.window.sent(now_s, len(framed))
        self._sent_s[None] = now_s
        if kind is not None:
            self.n_sent[kind.name.lower()] += len(framed)
        earned = -len(framed) if kind in PICTURES else PICTURE_SHARE * len(framed)
        self._credit = min(self._credit + earned, MOST_CREDIT_BYTES)
        return framed

    def _next_kind(self, now_s: float, rate: float) -> Kind | None:
        """First kind in order of priority of which a piece can go now."""
        for kind in ORDER:
            if kind is Kind.COARSE and self._credit > 0:
                for picture in PICTURES:
                    if self._can_send(picture, now_s, rate, PICTURE_SHARE * rate):
                        return picture
            share = rate
            if kind in PICTURES:
                # one that fits in the share goes on in it
                busy = self._waiting[Kind.COARSE] or self._waiting[Kind.FINE]
                share = PICTURE_SHARE * rate if busy else rate / 2
            if self._can_send(kind, now_s, rate, share):
                return kind
        return None

    def _can_send(self, kind: Kind, now_s: float, rate: float, share: float) -> bool:
        """True if an item of a kind is partly sent, or one can begin."""
        if kind in self._partial:
            return True
        if now_s - self._sent_s[kind] < self._every_s(kind, rate):
            return False
        while self._waiting[kind]:
            keys, payload = self._taken(kind, now_s, share)
            if payload is not None:  # else the store has given it up
                self._sent_s[kind] = now_s
                self._partial[kind] = _Partial(keys, payload)
                return True
        return False

    def _every_s(self, kind: Kind, rate: float) -> float:
        if kind is Kind.POSE:
            return 1.0 / POSES_BESIDE_HZ if self.datagrams_work else self._pose_every_s()
        if kind is Kind.STATUS:
            return STATUS_EVERY_S
        if kind is Kind.OBSTACLES:
            return max(1.0 / OBSTACLES_HZ, OBSTACLES_BYTES / (OBSTACLES_SHARE * rate))
        return 1.0 / PICTURES_HZ if kind in PICTURES else 0.0

    def _pose_every_s(self) -> float:
        often = POSE_SHARE * self.rate_bytes_s / POSE_BYTES
        return 1.0 / min(max(often, LEAST_POSES_HZ), MOST_POSES_HZ)

    def _taken(self, kind: Kind, now_s: float, share: float) -> tuple[Keys, bytes | None]:
        """Take out what waits, newest first; log lines, which a person reads, oldest first."""
        waiting = self._waiting[kind]
        if kind is Kind.PLACES:
            keys = [waiting.popitem()[0] for _ in range(min(len(waiting), PLACES_AT_ONCE))]
            places = b"".join(self._store.get(kind, key) or b"" for key in keys)
            return keys, bytes(8) + places
        if kind is Kind.LOG:
            key = next(iter(waiting))
            del waiting[key]
        else:
            key = waiting.popitem()[0]
        if kind is Kind.POSE:
            self._pose_is_new = False
        if kind is Kind.STATUS:
            return [key], self._status(now_s)
        if kind is Kind.PICTURE:
            return [key], self._pictures.encoded(self._store.image, share)
        return [key], self._store.get(kind, key)

    def _status(self, now_s: float) -> bytes | None:
        status = self._store.status
        if status is None:
            return None
        window = self.window
        link = {
            "link_kbit_s": round(window.rate_bytes_s / 125),
            "round_trip_ms": round(1e3 * (window.round_trip_s or 0.0)),
            "budget_kbit_s": round(self.limit_bytes_s / 125) or None,
            "waiting": self.n_waiting,
            "skipped": dict(self.n_skipped),
            "given_up": dict(self._store.n_evicted),
        }
        return encode(replace(status, facts={**status.facts, **link}))

    def _queue_again(self, kind: Kind, keys: Keys) -> None:
        for key in keys:
            if key not in self._waiting[kind]:
                self._waiting[kind] = {key: None, **self._waiting[kind]}
