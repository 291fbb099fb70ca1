"""Wire held by MAVSDK: it opens, reads, checks and writes in its own threads.

Each packet is stamped in MAVSDK's thread as it comes, and reaches the event loop through a socket
pair, which bounds the backlog.
"""

from __future__ import annotations

import asyncio
import os
import socket
import struct
import time

import mavsdk

from companion.errors import ConfigError, SourceError
from companion.timing.rate_limit import RateLimit
from drivers.mavlink.wire.baud import BAUDS, BaudSearch
from drivers.mavlink.wire.link_url import Endpoint
from drivers.mavlink.wire.mavsdk_carrier import Carrier, complaints
from drivers.mavlink.wire.send_queue import PacketQueue
from drivers.mavlink.wire.thread_call import in_thread
from drivers.mavlink.wire.wire import Wire, WireEnd

KIND_OF = {"serial": "serial", "udpin": "udpin", "udpout": "udpout", "tcp": "tcpout"}
NETWORK_BYTES_PER_S = 1e6
BURST_S = 0.05
QUEUE_BYTES = 64_000
STAMP = struct.Struct("=q")
LONGEST = 512
PAIR_BYTES = 1 << 20
SILENT_NS = 5_000_000_000
"""A serial line that was heard and is silent for this long is reopened."""
END_S = 1.5


class MavsdkWire(Wire):
    """Wire of a link's URL. ConfigError where MAVSDK does not support it.

    A listener answers every peer that has sent to it.
    """

    read_size = LONGEST

    def __init__(self, endpoint: Endpoint) -> None:
        super().__init__(str(endpoint), NETWORK_BYTES_PER_S, PacketQueue(QUEUE_BYTES))
        if ":" in endpoint.host:
            raise ConfigError(
                f'link.url: "{endpoint}": MAVSDK has no IPv6; set expert.link.backend = "pymavlink"'
            )
        self._endpoint = endpoint
        self.is_line = endpoint.kind == "serial"
        self._search = BaudSearch((endpoint.baud,) if endpoint.baud else BAUDS)
        self._searching = False
        self._pace = RateLimit(self.bytes_per_s, LONGEST)
        self._carrier: Carrier | None = None
        self._pair: tuple[socket.socket, socket.socket] | None = None
        self._device: tuple[int, int, int] | None = None
        self._heard_ns = 0
        self._ending: asyncio.Future[None] | None = None

    async def run(self, end: WireEnd) -> None:
        """Keep the wire open until cancelled; then MAVSDK has ended, or is abandoned."""
        try:
            await super().run(end)
        finally:
            await self._ended()

    async def serve(self, fd: int, end: WireEnd) -> None:
        """See `Wire`."""
        self._look_later(self._look)
        await super().serve(fd, end)

    async def _open(self) -> int:
        await self._ended()
        if self.is_line:
            if not self._searching:
                self._search.begin(time.monotonic_ns())
            self._searching = False
            self.bytes_per_s = self._search.baud / 10
            self._device = self._identity_of_device()
        self._pace = RateLimit(self.bytes_per_s, max(LONGEST, self.bytes_per_s * BURST_S))
        self._heard_ns = 0
        self._pair = ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for each in self._pair:
            each.setblocking(False)
            each.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, PAIR_BYTES)

        def take(packet: bytes) -> None:
            stamp = STAMP.pack(time.monotonic_ns())
            try:
                theirs.send(stamp + packet)
            except OSError:
                pass  # full: what does not get into a kernel's buffer is lost too

        self._carrier = Carrier(self._mavsdk_url(), take)
        try:
            await in_thread(self._carrier.start, "mavsdk start")
        except mavsdk.MavsdkError as error:
            self._close()
            raise SourceError(f"{self.name}: {complaints.newest or error}") from error
        except BaseException:
            self._close()
            raise
        return ours.fileno()

    def _close(self) -> None:
        carrier, pair, self._carrier, self._pair = self._carrier, self._pair, None, None

        def end() -> None:
            if carrier is not None:
                carrier.end()
            for each in pair or ():
                each.close()

        self._ending = in_thread(end, "mavsdk end")

    async def _ended(self) -> None:
        if self._ending is not None:
            await asyncio.wait((self._ending,), timeout=END_S)

    def _read(self) -> tuple[bytes, int]:
        assert self._pair is not None
        data = self._pair[0].recv(self.read_size)
        return data[STAMP.size :], STAMP.unpack_from(data)[0]

    def _deliver(self, end: WireEnd, data: bytes, monotonic_ns: int) -> None:
        self._heard_ns = monotonic_ns
        self.trouble = ""
        self._search.heard(len(data), self._accept(end, data, monotonic_ns), monotonic_ns)

    def _write(self, data: bytes) -> int:
        assert self._carrier is not None
        self._carrier.send(data)
        self._pace.take(len(data))
        return len(data)

    def _room(self) -> float:
        # so that what waits, waits here, where the oldest is given up
        self._pace.refill(time.monotonic_ns())
        return self._pace.wait_s() if self._pace.left < 0 else 0.0

    def _look(self) -> None:
        """Reopen a serial line: MAVSDK does not see it go, nor reopen it; a network's it does."""
        self._look_later(self._look)
        now_ns = time.monotonic_ns()
        if not self._heard_ns and complaints.newest:
            self.trouble = f"{self.name}: {complaints.newest}"
        if not self.is_line:
            return
        if self._identity_of_device() != self._device:
            self.lose("unplugged")
        elif self._heard_ns and now_ns - self._heard_ns > SILENT_NS:
            self.lose("fell silent")
        elif self._search.look(now_ns):
            self._searching = True
            self.lose(f"no MAVLink heard yet, listening at {self._search.baud} baud")

    def _identity_of_device(self) -> tuple[int, int, int] | None:
        try:
            status = os.stat(self._endpoint.device)
        except OSError:
            return None
        return status.st_dev, status.st_ino, status.st_rdev

    def _mavsdk_url(self) -> str:
        kind = KIND_OF[self._endpoint.kind]
        if self.is_line:
            return f"{kind}://{self._endpoint.device}:{self._search.baud}"
        return f"{kind}://{self._endpoint.host}:{self._endpoint.port}"
