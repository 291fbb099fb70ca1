"""Wires of a simulated autopilot: UDP, TCP, and a pty as a serial port."""

from __future__ import annotations

import contextlib
import os
import random
import select
import socket
import termios
import tty
from pathlib import Path
from typing import Protocol


class Wire(Protocol):
    """Bytes in and out without waiting; what cannot be sent is lost, as on any of these."""

    url: str
    """What the other side configures."""

    def plug(self) -> None: ...
    def unplug(self) -> None: ...
    def wait(self, seconds: float) -> None: ...
    def receive(self) -> list[bytes]: ...
    def send(self, data: bytes) -> None: ...


def free_port(kind: int = socket.SOCK_DGRAM) -> int:
    """A port of loopback that nobody uses just now."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class UdpWire:
    """`udpout` speaks to an address at once; `udpin` to whom it last heard from."""

    def __init__(self, kind: str, host: str, port: int) -> None:
        self._kind, self._host = kind, host or "127.0.0.1"
        self._port = port or free_port()
        self._peer = (self._host, self._port) if kind == "udpout" else None
        other = "udpin" if kind == "udpout" else "udpout"
        self.url = f"{other}:{self._host}:{self._port}"
        self._socket: socket.socket | None = None

    def plug(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        if self._kind == "udpin":
            self._socket.bind((self._host, self._port))
            self._peer = None

    def unplug(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def wait(self, seconds: float) -> None:
        _wait(self._socket, seconds)

    def receive(self) -> list[bytes]:
        out: list[bytes] = []
        while self._socket is not None:
            try:
                data, peer = self._socket.recvfrom(65536)
            except BlockingIOError:
                break
            except OSError:  # "connection refused": nobody listens there yet
                continue
            out.append(data)
            if self._kind == "udpin":
                self._peer = peer
        return out

    def send(self, data: bytes) -> None:
        if self._socket is not None and self._peer is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(data, self._peer)


class TcpWire:
    """`tcpin`: one client at a time, the newest."""

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host or "127.0.0.1", port or free_port(socket.SOCK_STREAM)
        self.url = f"tcp:{self._host}:{self._port}"
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None

    def plug(self) -> None:
        self._listener = socket.create_server((self._host, self._port))
        self._listener.setblocking(False)

    def unplug(self) -> None:
        for each in (self._client, self._listener):
            if each is not None:
                each.close()
        self._client = self._listener = None

    def wait(self, seconds: float) -> None:
        _wait(self._client or self._listener, seconds)

    def receive(self) -> list[bytes]:
        if self._listener is not None:
            with contextlib.suppress(BlockingIOError):
                client, _ = self._listener.accept()
                client.setblocking(False)
                if self._client is not None:
                    self._client.close()
                self._client = client
        if self._client is None:
            return []
        try:
            data = self._client.recv(65536)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if not data:
            self._client.close()
            self._client = None
        return [data]

    def send(self, data: bytes) -> None:
        if self._client is not None:
            with contextlib.suppress(OSError):
                self._client.send(data)


class PtyWire:
    """A serial port: `link` is a stable path to it, gone while unplugged.

    With a `baud` the bytes are rubbish both ways until the other side has set that speed.
    """

    def __init__(self, link: Path, baud: int = 0) -> None:
        self.link = link
        self._baud = baud
        self.url = f"serial:{link}:{baud or 'auto'}"
        self._ends: tuple[int, int] | None = None
        self._noise = random.Random(1)

    def plug(self) -> None:
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        self._ends = master, slave
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(os.ttyname(slave))

    def unplug(self) -> None:
        if self._ends is not None:
            self.link.unlink(missing_ok=True)
            for end in self._ends:
                os.close(end)
            self._ends = None

    def wait(self, seconds: float) -> None:
        _wait(self._ends[0] if self._ends else None, seconds)

    def receive(self) -> list[bytes]:
        if self._ends is None:
            return []
        try:
            return [self._heard(os.read(self._ends[0], 65536))]
        except OSError:
            return []

    def send(self, data: bytes) -> None:
        if self._ends is not None:
            with contextlib.suppress(OSError):
                os.write(self._ends[0], self._heard(data))

    def _heard(self, data: bytes) -> bytes:
        """What comes of bytes: rubbish where the two ends have set different speeds."""
        if not self._baud or self._ends is None:
            return data
        speed = getattr(termios, f"B{self._baud}")
        if termios.tcgetattr(self._ends[1])[5] == speed:
            return data
        return bytes(self._noise.randrange(256) for _ in data)


def wire(url: str) -> UdpWire | TcpWire | PtyWire:
    """udpout:HOST:PORT, udpin:HOST:PORT, tcpin:HOST:PORT (0: a free port), pty:LINK[:BAUD]."""
    kind, _, rest = url.partition(":")
    if kind == "pty":
        link, _, baud = rest.partition(":")
        return PtyWire(Path(link), int(baud or 0))
    host, _, port = rest.rpartition(":")
    if kind in ("udpin", "udpout"):
        return UdpWire(kind, host, int(port))
    if kind == "tcpin":
        return TcpWire(host, int(port))
    raise ValueError(f"no such wire: {url}")


def _wait(end: socket.socket | int | None, seconds: float) -> None:
    # what another thread unplugs while it is waited for
    with contextlib.suppress(OSError, ValueError):
        select.select([] if end is None else [end], [], [], max(0.0, seconds))
