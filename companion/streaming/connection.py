"""On-board end of a viewer's TCP connection: a non-blocking socket."""

from __future__ import annotations

import contextlib
import select
import socket
import struct

from companion.errors import StreamError
from companion.streaming.framing import ACKNOWLEDGED, HELLO, HELLO_BYTES, VIEWER_BYTES
from companion.streaming.session import Session

NOT_SENT_BYTES = 4096
"""TCP_NOTSENT_LOWAT: the kernel buffers no more than this beyond what is in flight."""
GIVE_UP_MS = 20_000
"""TCP_USER_TIMEOUT: a viewer unreachable for this long reconnects."""
HEADERS_BYTES = 66
"""Headers of a packet: Ethernet, IP and TCP with time stamps."""
TCP_INFO_BYTES, SEGMENTS_AT, SENT_AT = 232, 136, 200
"""Size of struct tcp_info (linux/tcp.h), and offsets of tcpi_segs_out and tcpi_bytes_sent."""
MOST_READ = 4096


class Connection:
    """Reads from a viewer; sends what its session has for it. OSError when it is gone.

    StreamError for a peer that is no viewer.
    """

    def __init__(self, opened: socket.socket, peer: str, now_s: float) -> None:
        self.socket, self.peer = opened, peer
        self.since_s = now_s
        self.viewer: bytes | None = None
        """Name of the viewer; None before its HELLO."""
        self.session: Session | None = None
        self._read = bytearray()
        self._left = b""
        self._n_charged = 0
        opened.setblocking(False)
        opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, NOT_SENT_BYTES)
        opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, GIVE_UP_MS)
        with contextlib.suppress(OSError):  # not every kernel has it
            # which a lossy radio does not make slow
            opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, b"bbr")

    def read(self, now_s: float) -> bool:
        """Read what has come; whether the viewer has just identified itself."""
        data = self.socket.recv(MOST_READ)
        if not data:
            raise ConnectionResetError("the viewer has closed the connection")
        self._read += data
        is_new = False
        if self.viewer is None:
            if not HELLO.startswith(bytes(self._read[: len(HELLO)])):
                raise StreamError("it is no viewer of companion, or one of another version")
            if len(self._read) < HELLO_BYTES:
                return False
            self.viewer = bytes(self._read[HELLO_BYTES - VIEWER_BYTES : HELLO_BYTES])
            del self._read[:HELLO_BYTES]
            is_new = True
        n = len(self._read) // ACKNOWLEDGED.size
        if n and self.session is not None:
            (total,) = ACKNOWLEDGED.unpack_from(self._read, (n - 1) * ACKNOWLEDGED.size)
            self.session.acknowledged(now_s, total)
            del self._read[: n * ACKNOWLEDGED.size]
        return is_new

    def send(self, now_s: float, budget_bytes: int) -> int:
        """Send a piece if there is one and the socket has capacity; number of bytes sent."""
        if self.session is None or not self.is_writable():
            return 0
        if not self._left:
            capacity = min(self.session.window.available_bytes(), budget_bytes)
            self._left = self.session.next_piece(now_s, capacity) or b""
            if not self._left:
                return 0
        n = self.socket.send(self._left)
        self._left = self._left[n:]
        return n

    def is_writable(self) -> bool:
        """True if the kernel takes more now."""
        return bool(select.select([], [self.socket], [], 0)[1])

    def wire_bytes(self, n_given: int) -> int:
        """Bytes on the wire, with headers and retransmissions, since the last call.

        `n_given` is what was given to the kernel, which may not have sent it yet.
        """
        info = self.socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, TCP_INFO_BYTES)
        total = n_given
        if len(info) >= SENT_AT + 8:
            (segments,) = struct.unpack_from("=I", info, SEGMENTS_AT)
            (sent,) = struct.unpack_from("=Q", info, SENT_AT)
            total = max(total, sent + HEADERS_BYTES * segments)
        more = max(0, total - self._n_charged)
        self._n_charged += more
        return more

    def close(self) -> None:
        """Close the socket."""
        self.socket.close()
