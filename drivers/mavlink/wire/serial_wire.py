"""MAVLink over a serial line, which may be unplugged and replugged."""

from __future__ import annotations

import fcntl
import os
import struct
import termios
import time

import serial

from companion.errors import SourceError
from drivers.mavlink.wire.baud import BAUDS, BaudSearch
from drivers.mavlink.wire.link_url import Endpoint
from drivers.mavlink.wire.send_queue import PacketQueue
from drivers.mavlink.wire.wire import Wire, WireEnd

BITS_PER_BYTE = 10
QUEUE_S, LEAST_QUEUE_BYTES = 0.25, 2000
KERNEL_S, LEAST_KERNEL_BYTES = 0.05, 300
"""Limit of the kernel's buffer, which would take seconds of packets at a slow rate: a late pose is
worse than none."""
VMIN = 6


class SerialWire(Wire):
    """Serial line, opened by its path, exclusively."""

    is_line = True

    def __init__(self, endpoint: Endpoint) -> None:
        super().__init__(str(endpoint), 0.0, PacketQueue(LEAST_QUEUE_BYTES))
        self.search = BaudSearch((endpoint.baud,) if endpoint.baud else BAUDS)
        self._device = endpoint.device
        self._serial: serial.Serial | None = None

    async def serve(self, fd: int, end: WireEnd) -> None:
        """See `Wire`."""
        self._look_later(self._look, end)
        await super().serve(fd, end)

    async def _open(self) -> int:
        self.search.begin(time.monotonic_ns())
        port = serial.Serial(timeout=0, write_timeout=0, exclusive=True)
        port.port = self._device
        try:
            port.baudrate = self.search.baud
            port.open()
            self._end_reads_at_hang_up(port.fileno())
            fcntl.ioctl(port.fileno(), termios.TIOCEXCL)  # who asks no lock would eat our bytes
        except (OSError, ValueError, termios.error) as error:
            port.close()
            raise SourceError(self._refusal(error)) from error
        try:
            port.set_low_latency_mode(True)  # an FTDI adapter would hold bytes back for 16 ms
        except (OSError, ValueError):
            pass  # not every driver has it, and none that has not needs it
        self._serial = port
        self._set_pace()
        return int(port.fileno())

    def _refusal(self, error: Exception) -> str:
        number = getattr(error, "errno", None)
        if not os.path.exists(self._device):
            return f"{self._device}: not there; is the autopilot plugged in and powered?"
        if number == 13:
            return f"{self._device}: no permission; add the user to the group dialout"
        if number in (11, 16):
            return f"{self._device}: in use by another program; let it be a client of the router"
        return f"{self._device}: {os.strerror(number) if number else error}"

    @staticmethod
    def _end_reads_at_hang_up(fd: int) -> None:
        # so that reading nothing means that the line is gone, and never that nothing has come
        attributes = termios.tcgetattr(fd)
        attributes[VMIN][termios.VMIN] = 1
        termios.tcsetattr(fd, termios.TCSANOW, attributes)

    def _set_pace(self) -> None:
        self.bytes_per_s = self.search.baud / BITS_PER_BYTE
        self.queue.most_bytes = int(max(LEAST_QUEUE_BYTES, QUEUE_S * self.bytes_per_s))

    def _close(self) -> None:
        if self._serial is None:
            return
        try:
            # closing would wait for what the other side no longer takes
            termios.tcflush(self._serial.fileno(), termios.TCIOFLUSH)
            fcntl.ioctl(self._serial.fileno(), termios.TIOCNXCL)
        except (OSError, termios.error):
            pass  # the device has gone
        self._serial.close()
        self._serial = None

    def _read(self) -> tuple[bytes, int]:
        data = os.read(self._fd, self.read_size)
        if not data:
            raise EOFError
        return data, time.monotonic_ns()

    def _deliver(self, end: WireEnd, data: bytes, monotonic_ns: int) -> None:
        found = self.search.found
        self.search.heard(len(data), self._accept(end, data, monotonic_ns), monotonic_ns)
        if self.search.garbled:
            self.trouble = f"{self.name}: bytes come, but no MAVLink at {self.search.baud} baud"
        elif self.search.found:
            self.trouble = ""
        if found and not self.search.found:
            self._look_later(self._look, end)

    def _look(self, end: WireEnd) -> None:
        if self._serial is None or self.search.found:
            return
        if self.search.look(time.monotonic_ns()):
            self._change_baud(end)
        self._look_later(self._look, end)

    def _change_baud(self, end: WireEnd) -> None:
        assert self._serial is not None
        self.trouble = f"{self.name}: no MAVLink heard yet, listening at {self.search.baud} baud"
        try:
            self._serial.baudrate = self.search.baud
            self._end_reads_at_hang_up(self._fd)
            termios.tcflush(self._fd, termios.TCIFLUSH)
        except ValueError:
            return  # not one of the device's; the next one comes in its turn
        except (OSError, termios.error) as error:
            self.lose(str(error))
            return
        self._set_pace()
        end.opened()

    def _room(self) -> float:
        try:
            (waiting,) = struct.unpack("i", fcntl.ioctl(self._fd, termios.TIOCOUTQ, bytes(4)))
        except OSError:
            return 0.0  # the line has gone, or does not tell: writing will say
        most = max(LEAST_KERNEL_BYTES, KERNEL_S * self.bytes_per_s)
        return 0.0 if waiting < most else max(0.001, (waiting - most / 2) / self.bytes_per_s)
