"""A serial line between autopilot and companion, no faster than its baud; a process of its own.

    python -m tests.firmware.serial_cable BAUD AUTOPILOT_PORT COMPANION_PORT FLIGHT.tlog

The ports are paths: of pseudo terminals, one for each end. What is not taken at an end in time is
lost, as in a UART. All that passes is written as a tlog. It ends with its standard input.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import struct
import sys
import time
import tty
from pathlib import Path
from typing import IO

from drivers.mavlink.wire.packet_stream import MavlinkStream

BITS_PER_BYTE = 10
TICK_S = 0.004


class OneWay:
    """Bytes from one end to the other, as many as the baud allows since they were asked for."""

    def __init__(self, source: int, sink: int, bytes_per_s: float, log: IO[bytes]) -> None:
        self._source, self._sink, self._log = source, sink, log
        self._bytes_per_s, self._room = bytes_per_s, 0.0
        self._stream = MavlinkStream()

    def step(self, passed_s: float) -> None:
        """Pass on what has come; a line that was idle has nothing saved up."""
        self._room = min(self._room, 1.0) + passed_s * self._bytes_per_s
        with contextlib.suppress(BlockingIOError):
            data = os.read(self._source, int(self._room))
            self._room -= len(data)
            self._write_down(data)
            os.write(self._sink, data)

    def _write_down(self, data: bytes) -> None:
        stamp = struct.pack(">Q", round(time.time() * 1e6))
        for packet in self._stream.feed(data, time.monotonic_ns()):
            self._log.write(stamp + packet.raw)


def opened(path: Path) -> tuple[int, int]:
    """A pseudo terminal whose far end is at a path: our end, and the far one, kept from closing."""
    ours, far = os.openpty()
    tty.setraw(far)
    os.set_blocking(ours, False)
    path.symlink_to(os.ttyname(far))
    return ours, far


def main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())  # with its log written
    baud, *paths, log_path = sys.argv[1:]
    bytes_per_s = int(baud) / BITS_PER_BYTE
    (autopilot, _), (companion, _) = (opened(Path(each)) for each in paths)
    with Path(log_path).open("wb") as log:
        ways = [
            OneWay(autopilot, companion, bytes_per_s, log),
            OneWay(companion, autopilot, bytes_per_s, log),
        ]
        last_s = time.monotonic()
        while not select.select([sys.stdin], [], [], TICK_S)[0]:
            now_s = time.monotonic()
            for way in ways:
                way.step(now_s - last_s)
            last_s = now_s


if __name__ == "__main__":
    main()
