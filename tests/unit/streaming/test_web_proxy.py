from __future__ import annotations

import errno
import os
import resource
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import pytest

from companion.streaming.viewer import web_proxy
from companion.streaming.viewer.web_proxy import LOOPBACK, WebProxy, free_ports
from tests.support.waiting import until


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
    thread.join(60)


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


@pytest.mark.real_time
def test_a_browser_that_takes_nothing_is_noticed_and_waited_for_but_not_for_ever() -> None:
    data = bytes(8 << 20)
    with served(data) as inner, gated(inner) as (proxy, port):
        with socket.create_connection((LOOPBACK, port), timeout=10) as browser:
            browser.sendall(b"give\n")
            until(lambda: proxy.is_lagging)
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


def test_it_serves_where_many_files_are_open() -> None:
    """With descriptors above 1023, of which select(2) knows nothing."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (before[1], before[1]))
    with ExitStack() as stack:
        stack.callback(resource.setrlimit, resource.RLIMIT_NOFILE, before)
        inner = stack.enter_context(served(b"here"))
        _, port = stack.enter_context(gated(inner))
        while stack.enter_context(open(os.devnull, "rb")).fileno() < 1024:
            pass
        with socket.create_connection((LOOPBACK, port), timeout=10) as browser:
            browser.sendall(b"give\n")
            assert all_of(browser) == b"here"


def test_more_connections_than_browsers_need_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_proxy, "MOST_CONNECTIONS", 2)
    with served(b"here") as inner, gated(inner) as (_, port), ExitStack() as stack:
        first, second, third = (
            stack.enter_context(socket.create_connection((LOOPBACK, port), timeout=10))
            for _ in range(3)
        )
        assert third.recv(10) == b""
        for browser in (first, second):  # which leaves room for others
            browser.sendall(b"give\n")
            assert all_of(browser) == b"here"
        with socket.create_connection((LOOPBACK, port), timeout=10) as later:
            later.sendall(b"give\n")
            assert all_of(later) == b"here"


class Refusing:
    """Listeners of a port for which there is no descriptor, so many times."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, port: int, most: int) -> None:
        self.n, self.begun = 0, threading.Event()
        accept = socket.socket.accept

        def refuse(listener: socket.socket) -> Any:
            if listener.getsockname()[1] != port or self.n == most:
                return accept(listener)
            self.n += 1
            self.begun.set()
            raise OSError(errno.EMFILE, "Too many open files")

        monkeypatch.setattr(socket.socket, "accept", refuse)


def test_a_connection_without_a_descriptor_costs_the_others_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(web_proxy, "PAUSE_S", 1e6)
    data = bytes(1 << 20)
    with served(data) as inner, gated(inner) as (proxy, port), ExitStack() as stack:
        first = stack.enter_context(socket.create_connection((LOOPBACK, port), timeout=10))
        until(lambda: proxy._directions)
        refusing = Refusing(monkeypatch, port, 1_000_000)
        stack.enter_context(socket.create_connection((LOOPBACK, port), timeout=10))
        assert refusing.begun.wait(60)
        first.sendall(b"give\n")
        assert all_of(first) == data
        assert refusing.n == 1, "it was not asked again and again"


def test_a_connection_without_a_descriptor_gets_one_later(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_proxy, "PAUSE_S", 0.0)
    with served(b"here") as inner, gated(inner) as (_, port):
        refusing = Refusing(monkeypatch, port, 3)
        with socket.create_connection((LOOPBACK, port), timeout=10) as browser:
            browser.sendall(b"give\n")
            assert all_of(browser) == b"here"
        assert refusing.n == 3


def test_a_port_in_use_is_an_error() -> None:
    with served(b"") as inner, pytest.raises(OSError, match="in use"):
        WebProxy({(LOOPBACK, inner): 1}, watched=inner)
