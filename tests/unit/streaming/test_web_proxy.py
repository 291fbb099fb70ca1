from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from companion.streaming.viewer.web_proxy import LOOPBACK, WebProxy, free_ports


@contextmanager
def served(data: bytes) -> Iterator[int]:
    """A server that sends the same to everybody, after it has heard a line."""
    with socket.create_server((LOOPBACK, 0)) as server:

        def serve() -> None:
            while True:
                try:
                    opened, _ = server.accept()
                except OSError:
                    return
                threading.Thread(target=answer, args=(opened,), daemon=True).start()

        def answer(opened: socket.socket) -> None:
            with opened:
                try:
                    opened.recv(100)
                    opened.sendall(data)
                except OSError:
                    pass

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield server.getsockname()[1]
        server.shutdown(socket.SHUT_RDWR)
    thread.join(5)


@contextmanager
def gated(inner: int) -> Iterator[tuple[WebProxy, int]]:
    (port,) = free_ports(1)
    proxy = WebProxy({(LOOPBACK, port): inner}, watched=port)
    try:
        yield proxy, port
    finally:
        proxy.close()


def all_of(opened: socket.socket) -> bytes:
    out = bytearray()
    while data := opened.recv(65536):
        out += data
    return bytes(out)


def test_all_goes_through_as_it_is_and_ends_when_it_ends() -> None:
    data = bytes(range(256)) * 20_000
    with served(data) as inner, gated(inner) as (proxy, port):
        for _ in range(2):
            with socket.create_connection((LOOPBACK, port), timeout=10) as browser:
                browser.sendall(b"give\n")
                assert all_of(browser) == data
        assert not proxy.is_lagging


def test_a_browser_that_takes_nothing_is_noticed_and_waited_for_but_not_for_ever() -> None:
    data = bytes(8 << 20)
    with served(data) as inner, gated(inner) as (proxy, port):
        with socket.create_connection((LOOPBACK, port), timeout=10) as browser:
            browser.sendall(b"give\n")
            end = time.monotonic() + 10
            while not proxy.is_lagging:
                assert time.monotonic() < end
                time.sleep(0.01)
            began = time.monotonic()
            proxy.wait_for_browsers(threading.Event())
            assert 1.5 < time.monotonic() - began < 4
            assert all_of(browser) == data
        proxy.wait_for_browsers(threading.Event())
        assert not proxy.is_lagging


def test_a_server_that_is_not_there_closes_the_connection() -> None:
    inner = free_ports(1)[0]
    with gated(inner) as (_, port):
        with socket.create_connection((LOOPBACK, port), timeout=10) as browser:
            assert browser.recv(10) == b""


def test_a_port_in_use_is_an_error() -> None:
    with served(b"") as inner, pytest.raises(OSError, match="in use"):
        WebProxy({(LOOPBACK, inner): 1}, watched=inner)
