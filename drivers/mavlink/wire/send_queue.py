"""Send queue of a wire."""

from __future__ import annotations

from collections import deque


class PacketQueue:
    """Whole packets that wait, at most `most_bytes`; the oldest are dropped for new ones."""

    def __init__(self, most_bytes: int) -> None:
        self.most_bytes = most_bytes
        self.n_dropped = 0
        self.n_bytes = 0
        self._packets: deque[bytes] = deque()
        self._head_begun = False

    def __len__(self) -> int:
        return len(self._packets)

    def push(self, packet: bytes) -> None:
        """Append a packet."""
        self._packets.append(packet)
        self.n_bytes += len(packet)
        while self.n_bytes > self.most_bytes and len(self._packets) > (1 + self._head_begun):
            self._drop()

    def head(self) -> bytes:
        """Oldest packet, or its unsent rest."""
        return self._packets[0]

    def pop(self) -> bytes:
        """Remove the oldest packet."""
        self._head_begun = False
        packet = self._packets.popleft()
        self.n_bytes -= len(packet)
        return packet

    def written(self, n_bytes: int) -> None:
        """Count sent bytes of the head; its rest stays at the head, whatever is dropped."""
        packet = self.pop()
        if n_bytes < len(packet):
            self._packets.appendleft(packet[n_bytes:])
            self.n_bytes += len(packet) - n_bytes
            self._head_begun = True

    def clear(self) -> None:
        """Drop all, counted."""
        self.n_dropped += len(self._packets)
        self._packets.clear()
        self.n_bytes = 0
        self._head_begun = False

    def _drop(self) -> None:
        # half a packet on the wire must be ended, or the reader loses the next one too
        begun = self._packets.popleft() if self._head_begun else None
        self.n_bytes -= len(self._packets.popleft())
        self.n_dropped += 1
        if begun is not None:
            self._packets.appendleft(begun)
