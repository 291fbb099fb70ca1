"""Framing of items on a TCP connection: in pieces, so that urgent items need not wait for others.

From the drone: kind (one byte, its high bit set in the last piece of an item), length (u16), piece.
Of each kind one item at a time is on its way, so that pieces of different kinds may mix. Kind 0
says only that the drone is there.

To the drone: HELLO, 16 bytes that name the viewer, then again and again how many bytes it has taken
in all (u64). Everything is little-endian.

Beside it go datagrams over UDP, between the same ports: to the drone HELLO, the name, and how many
have come (u32), once a second; from the drone kind and payload of a pose, which so does not wait
until TCP has repaired what was lost before it. Where datagrams do not get through, nothing is
missing.
"""

from __future__ import annotations

import struct

from companion.errors import StreamError

HELLO = b"CMPV\x02"
VIEWER_BYTES = 16
HELLO_BYTES = len(HELLO) + VIEWER_BYTES
ACKNOWLEDGED = struct.Struct("<Q")
COUNT = struct.Struct("<I")
HEAD = struct.Struct("<BH")
HEAD_BYTES = HEAD.size
LAST = 0x80
MOST_ITEM_BYTES = 16 << 20


def frame(kind: int, piece: bytes, is_last: bool) -> bytes:
    """A piece with its header."""
    return HEAD.pack(kind | (LAST if is_last else 0), len(piece)) + piece


def hello_datagram(viewer: bytes, n_received: int) -> bytes:
    """Datagram of a viewer: its name, and the number of datagrams received."""
    return HELLO + viewer + COUNT.pack(n_received & 0xFFFFFFFF)


def read_hello(data: bytes) -> tuple[bytes, int] | None:
    """Name and count of such a datagram; None for any other."""
    if len(data) != HELLO_BYTES + COUNT.size or not data.startswith(HELLO):
        return None
    (n_received,) = COUNT.unpack(data[HELLO_BYTES:])
    return data[len(HELLO) : HELLO_BYTES], n_received


class Reassembly:
    """Reassembles items from bytes."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        self._items: dict[int, bytearray] = {}

    def take(self, data: bytes) -> list[tuple[int, bytes]]:
        """Kind and payload of completed items; StreamError for malformed data."""
        self._bytes += data
        out = []
        at = 0
        while len(self._bytes) - at >= HEAD_BYTES:
            kind, length = HEAD.unpack_from(self._bytes, at)
            end = at + HEAD_BYTES + length
            if len(self._bytes) < end:
                break
            item = self._items.setdefault(kind & ~LAST, bytearray())
            item += self._bytes[at + HEAD_BYTES : end]
            at = end
            if len(item) > MOST_ITEM_BYTES:
                raise StreamError("an item that is too large came over the link")
            if kind & LAST:
                out.append((kind & ~LAST, bytes(self._items.pop(kind & ~LAST))))
        del self._bytes[:at]
        return out
