"""MAVLink over UDP, stamped by the kernel on reception."""

from __future__ import annotations

import socket
import struct
import time

from companion.errors import SourceError
from companion.timing.rate_limit import RateLimit
from drivers.mavlink.wire.host_address import resolve
from drivers.mavlink.wire.link_url import Endpoint
from drivers.mavlink.wire.send_queue import PacketQueue
from drivers.mavlink.wire.wire import Wire, WireEnd

SO_TIMESTAMPNS = 35  # Linux, which Python has no name for
TIMESPEC = struct.Struct("qq")
MOST_AGE_NS = 500_000_000
STEP_NS = 1_000_000
READINGS = 5
PEER_SILENT_NS = 1_500_000_000
NETWORK_BYTES_PER_S = 250e3
"""More than any autopilot sends or receives."""


def clocks_at_once() -> tuple[int, int]:
    """CLOCK_MONOTONIC and the system clock, in nanoseconds, as near in time as they can be read.

    Read again where the process had to wait between them, which would look like a clock that was
    set; not for ever, since on a starved computer it may wait each time.
    """
    for _ in range(READINGS):
        now_ns = time.monotonic_ns()
        unix_ns = time.time_ns()
        if time.monotonic_ns() - now_ns < STEP_NS // 2:
            break
    return now_ns, unix_ns


class KernelStamps:
    """Receive stamps of the kernel (system clock) as CLOCK_MONOTONIC.

    The interval from stamp to now is short, and measured by one clock; only where that clock was
    set meanwhile, the time of reading is taken.
    """

    def __init__(self) -> None:
        now_ns, unix_ns = clocks_at_once()
        self._unix_minus_monotonic_ns = unix_ns - now_ns

    def monotonic_ns(self, unix_ns: int | None) -> int:
        """Arrival of a packet that has just been read; `unix_ns` is the kernel's stamp."""
        now_ns, unix_now_ns = clocks_at_once()
        offset_ns = unix_now_ns - now_ns
        was_set = abs(offset_ns - self._unix_minus_monotonic_ns) > STEP_NS
        self._unix_minus_monotonic_ns = offset_ns
        if unix_ns is None or was_set:
            return now_ns
        age_ns = now_ns + offset_ns - unix_ns
        return now_ns - age_ns if 0 <= age_ns < MOST_AGE_NS else now_ns


class UdpWire(Wire):
    """UDP with one peer: the one given, or, where `listens`, the first that sends MAVLink.

    A listener keeps to its peer until that has been silent for a while: nobody else can take the
    link over, and an autopilot that comes back from another port is found again.
    """

    reads_at_once = 16

    def __init__(
        self,
        endpoint: Endpoint,
        queue: PacketQueue,
        read_limit: RateLimit | None = None,
        listens: bool = False,
    ) -> None:
        super().__init__(str(endpoint), NETWORK_BYTES_PER_S, queue, read_limit)
        self.peer: tuple[str, int] | None = None
        self.n_strange = 0
        """Datagrams from others than the peer."""
        self._endpoint = endpoint
        self._listens = listens
        self._socket: socket.socket | None = None
        self._stamps = KernelStamps()
        self._sender: tuple[str, int] = ("", 0)
        self._heard_ns = 0

    @property
    def port(self) -> int:
        """Bound port; 0 while it is not open."""
        return 0 if self._socket is None else int(self._socket.getsockname()[1])

    async def _open(self) -> int:
        family, address = await resolve(self._endpoint.host, self._endpoint.port)
        opened = socket.socket(family, socket.SOCK_DGRAM)
        try:
            opened.setblocking(False)
            opened.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
            if self._listens:
                opened.bind(address)
            else:
                # not connected: its own address may change under it, with the network's
                self.peer = address
        except OSError as error:
            opened.close()
            raise SourceError(f"{self.name}: {error.strerror}") from error
        self._socket = opened
        return opened.fileno()

    def _close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self._listens:
            self.peer = None

    def _read(self) -> tuple[bytes, int]:
        assert self._socket is not None
        data, ancillary, _, sender = self._socket.recvmsg(self.read_size, 64)
        self._sender = sender[0], sender[1]
        stamp = None
        for level, kind, value in ancillary:
            if level == socket.SOL_SOCKET and kind == SO_TIMESTAMPNS and len(value) == 16:
                seconds, nanoseconds = TIMESPEC.unpack(value)
                stamp = seconds * 1_000_000_000 + nanoseconds
        return data, self._stamps.monotonic_ns(stamp)

    def _deliver(self, end: WireEnd, data: bytes, monotonic_ns: int) -> None:
        if self._sender == self.peer:
            self._heard_ns = monotonic_ns
            self._accept(end, data, monotonic_ns)
            return
        if not self._listens or (
            self.peer is not None and monotonic_ns - self._heard_ns < PEER_SILENT_NS
        ):
            self.n_strange += 1
            return
        end.opened()
        before, self.peer = self.peer, self._sender  # so that it can be answered at once
        if end.received(data, monotonic_ns):
            self._heard_ns = monotonic_ns
            if self.tap is not None:  # only now: until then it may have been anybody's
                self.tap(False, data, monotonic_ns)
        else:
            self.peer = before
            self.n_strange += 1

    def _write(self, data: bytes) -> int:
        assert self._socket is not None
        if self.peer is None:
            self.n_unsent += 1
            return len(data)
        try:
            self._socket.sendto(data, self.peer)
        except (BlockingIOError, InterruptedError):
            raise
        except OSError as error:  # the network is away: the socket stays good
            self.n_unsent += 1
            self.trouble = f"{self.name}: {error.strerror}"
        else:
            self.trouble = ""
        return len(data)
