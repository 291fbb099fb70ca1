"""The line between autopilot and companion, by UDP, with faults on demand; a process of its own.

    python -m tests.firmware.faulty_cable AUTOPILOT_PORT COMPANION_PORT[,ANOTHER] FLIGHT.tlog

It stands at the first port, where the firmware sends to, and speaks to the companion at the second.
Two companions hear each other, as by a router. All that passes is written as a tlog. Orders are
lines on standard input:

    cut S            nothing passes for S seconds
    lose SHARE S     so many datagrams are lost, either way
    disturb SHARE S  so many come twice or up to LATE_S late
"""

from __future__ import annotations

import heapq
import os
import random
import select
import signal
import socket
import struct
import sys
import time
from pathlib import Path
from typing import IO

LATE_S = 0.2
BUFFER_BYTES = 4 << 20
MAVLINK_1, MAVLINK_2 = 0xFE, 0xFD


def packets(data: bytes) -> list[bytes]:
    """A datagram's MAVLink packets; what follows one that is none is left out."""
    found = []
    while len(data) >= 8:
        if data[0] == MAVLINK_2:
            length = 12 + data[1] + (13 if data[2] & 1 else 0)
        elif data[0] == MAVLINK_1:
            length = 8 + data[1]
        else:
            break
        found.append(data[:length])
        data = data[length:]
    return found


class FaultyCable:
    """See above."""

    def __init__(self, autopilot_port: int, companion_ports: list[int], log: IO[bytes]) -> None:
        self.autopilot, self.companion = (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)
        )
        for each in (self.autopilot, self.companion):
            each.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        self.autopilot.bind(("127.0.0.1", autopilot_port))
        self._companions_at = [("127.0.0.1", port) for port in companion_ports]
        self._autopilot_at: tuple[str, int] | None = None
        self._log = log
        self._until_s = {"cut": 0.0, "lose": 0.0, "disturb": 0.0}
        self._share = {"lose": 0.0, "disturb": 0.0}
        self._late: list[tuple[float, int, bool, bytes]] = []
        self._n_late = 0
        self._random = random.Random(1)

    def order(self, line: str) -> None:
        """Take one of the orders."""
        word, *numbers = line.split()
        self._until_s[word] = time.time() + float(numbers[-1])
        if word in self._share:
            self._share[word] = float(numbers[0])

    def run(self) -> None:
        """Pass on until standard input ends."""
        while True:
            now_s = time.time()
            wait_s = max(0.0, self._late[0][0] - now_s) if self._late else 0.5
            ready, _, _ = select.select([self.autopilot, self.companion, sys.stdin], [], [], wait_s)
            while self._late and self._late[0][0] <= time.time():
                _, _, up, data = heapq.heappop(self._late)
                self._send(data, up)
            for each in ready:
                if not isinstance(each, socket.socket):
                    lines = os.read(sys.stdin.fileno(), 4096).decode()
                    if not lines:
                        return
                    for line in lines.splitlines():
                        self.order(line)
                else:
                    self._pass(each)

    def close(self) -> None:
        """Unplug it."""
        self.autopilot.close()
        self.companion.close()

    def _pass(self, source: socket.socket) -> None:
        up = source is self.companion
        try:
            data, peer = source.recvfrom(1 << 16)
        except OSError:  # nobody at the other end yet
            return
        if not up:
            self._autopilot_at = peer
        for other in self._companions_at if up else ():
            if other != peer:
                self.companion.sendto(data, other)
        self.take(data, up)

    def take(self, data: bytes, up: bool) -> None:
        """Pass a datagram on, if it comes through; `up`: to the autopilot."""
        now_s = time.time()
        if now_s < self._until_s["cut"]:
            return
        if now_s < self._until_s["lose"] and self._random.random() < self._share["lose"]:
            return
        if now_s < self._until_s["disturb"] and self._random.random() < self._share["disturb"]:
            twice = self._random.random() < 0.5
            if twice:
                self._send(data, up)
            self._n_late += 1
            at_s = now_s + self._random.uniform(0.0, LATE_S)
            heapq.heappush(self._late, (at_s, self._n_late, up, data))
            return
        self._send(data, up)

    def _send(self, data: bytes, up: bool) -> None:
        stamp = struct.pack(">Q", round(time.time() * 1e6))
        self._log.write(b"".join(stamp + packet for packet in packets(data)))
        try:
            if not up:
                for companion in self._companions_at:
                    self.companion.sendto(data, companion)
            elif self._autopilot_at is not None:
                self.autopilot.sendto(data, self._autopilot_at)
        except OSError:
            return  # nobody there: as with a cable


def main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())  # with its log written
    autopilot_port, companion_ports, path = sys.argv[1:]
    with Path(path).open("wb") as log:
        FaultyCable(int(autopilot_port), list(map(int, companion_ports.split(","))), log).run()


if __name__ == "__main__":
    main()
