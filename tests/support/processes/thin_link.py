"""A link from a session to a viewer in simulated time: rate, delay and the viewer's own pace."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from companion.streaming.framing import Reassembly
from companion.streaming.item_codec import decode
from companion.streaming.items import Item
from companion.streaming.send_window import TokenBucket
from companion.streaming.session import Session

STEP_S = 0.005
HEADERS = 66


class ThinLink:
    """Bytes leave at `bytes_s`, arrive `delay_s` later; the same delay is on the way back."""

    def __init__(
        self, session: Session, bytes_s: float, delay_s: float, budget_kbit_s: float = 0.0
    ) -> None:
        self.session, self.bytes_s, self.delay_s = session, bytes_s, delay_s
        self.now_s = 0.0
        self.is_up = True
        self.viewer_takes = True
        self.arrived: list[tuple[float, Item]] = []
        self.n_arrived = self.n_sent = 0
        self.most_queued_s = 0.0
        self._budget = TokenBucket(budget_kbit_s)
        self._on_way: deque[tuple[float, bytes]] = deque()
        self._acknowledged: deque[tuple[float, int]] = deque()
        self._free_s = 0.0
        self._parts = Reassembly()
        session.limit_bytes_s = self._budget.bytes_s

    def run(self, seconds: float, each: Callable[[float], None] = lambda now_s: None) -> None:
        """Go on for so long; `each` is called at every step."""
        until_s = self.now_s + seconds
        while self.now_s < until_s:
            self.now_s += STEP_S
            each(self.now_s)
            self._send()
            self._arrive()

    def reconnect(self) -> None:
        """As after an outage: what was on its way is lost."""
        self._on_way.clear()
        self._acknowledged.clear()
        self._free_s = self.now_s
        self._parts = Reassembly()
        self.n_arrived = 0
        self.session.reconnected()

    def _send(self) -> None:
        while self.is_up:
            room = min(
                self.session.window.available_bytes(), self._budget.available_bytes(self.now_s)
            )
            piece = self.session.next_piece(self.now_s, room)
            if piece is None:
                return
            self._budget.charge(len(piece) + HEADERS)
            self.n_sent += len(piece) + HEADERS
            self._free_s = max(self._free_s, self.now_s) + (len(piece) + HEADERS) / self.bytes_s
            self.most_queued_s = max(self.most_queued_s, self._free_s - self.now_s)
            self._on_way.append((self._free_s + self.delay_s, piece))

    def _arrive(self) -> None:
        while self.viewer_takes and self._on_way and self._on_way[0][0] <= self.now_s:
            _, piece = self._on_way.popleft()
            self.n_arrived += len(piece)
            for kind, payload in self._parts.take(piece):
                if kind != 0:
                    self.arrived.append((self.now_s, decode(kind, payload)))
            self._acknowledged.append((self.now_s + self.delay_s, self.n_arrived))
        while self._acknowledged and self._acknowledged[0][0] <= self.now_s:
            self.session.acknowledged(self.now_s, self._acknowledged.popleft()[1])
