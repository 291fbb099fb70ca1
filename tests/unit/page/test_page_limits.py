"""Peers that ask too much, too slowly, or rubbish cost the page a slot for some seconds at most."""

from __future__ import annotations

import http.client
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from companion.page import bounded_server, gate
from tests.support.served_page import ELSEWHERE, HERE, ServedPage
from tests.support.waiting import until


@pytest.fixture
def served(tmp_path: Path) -> Iterator[ServedPage]:
    with ServedPage(tmp_path) as served:
        yield served


def get(served: ServedPage, path: str = "/now/panel") -> int:
    connection = http.client.HTTPConnection(HERE, served.port, timeout=10)
    try:
        connection.request("GET", path)
        return connection.getresponse().status
    finally:
        connection.close()


def sent(served: ServedPage, data: bytes) -> bytes:
    """All that comes back, until the page closes the connection."""
    with socket.create_connection((HERE, served.port), timeout=10) as peer:
        received = bytearray()
        try:
            peer.sendall(data)
            while more := peer.recv(65536):
                received += more
        except ConnectionError:
            pass
    return bytes(received)


def test_it_serves(served: ServedPage) -> None:
    assert get(served) == 200


def test_rubbish_is_refused(
    served: ServedPage, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bounded_server, "REFUSED_S", 0.2)
    for rubbish in (b"\x00\xff" * 2000, b"GET\r\n\r\n", b"POST / HTTP/1.1\r\n\r\n", b"A" * 60000):
        assert b" 400 " in sent(served, rubbish)
    assert get(served) == 200
    assert capfd.readouterr().err == ""  # a line for each would drown the journal


def test_rubbish_without_end_is_refused_once_and_not_read(served: ServedPage) -> None:
    n_bytes, rubbish = 0, b"\x00\xff" * 32768
    with socket.create_connection((HERE, served.port), timeout=10) as peer:
        peer.sendall(rubbish[:2000])
        assert peer.recv(65536).startswith(b"HTTP/1.1 400 ")
        peer.setblocking(False)
        with pytest.raises(BlockingIOError):
            while n_bytes < 64 << 20:  # more than the kernel keeps of one connection
                n_bytes += peer.send(rubbish)
        assert get(served) == 200
    until(lambda: not served.server.server_state.connections)


@pytest.mark.parametrize("head", [b"Content-Length: 70000", b"Content-Length: x"])
def test_long_bodies_are_refused_before_they_come(served: ServedPage, head: bytes) -> None:
    request = b"POST /pair HTTP/1.1\r\nHost: localhost\r\n" + head + b"\r\n\r\n"
    assert sent(served, request)[9:12] in (b"413", b"400")
    assert get(served) == 200


def test_long_bodies_of_unknown_length_are_refused(served: ServedPage) -> None:
    head = (
        b"POST /pair HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n"
        b"Content-Type: application/x-www-form-urlencoded\r\nConnection: close\r\n\r\n"
    )
    chunk = b"2000\r\n" + b"a" * 0x2000 + b"\r\n"
    assert sent(served, head + 12 * chunk + b"0\r\n\r\n")[9:12] == b"403"
    assert get(served) == 200


def test_who_asks_nothing_is_closed(served: ServedPage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounded_server, "REQUEST_S", 0.2)
    for begun in (b"", b"GET / HTTP/1.1\r\n", b"POST /pair HTTP/1.1\r\nContent-Length: 9\r\n\r\n"):
        assert b"HTTP/1.1 200" not in sent(served, begun)
    assert get(served) == 200


def test_who_takes_no_answer_is_closed(served: ServedPage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounded_server, "NOT_TAKEN_S", 0.2)
    flight = served.flights / "00001-2026-11-20T10-00-00Z"
    flight.mkdir()
    (flight / "flight.mcap").write_bytes(bytes(32 << 20))
    path = f"/flights/{flight.name}/file/flight.mcap"
    request = f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode()
    with socket.create_connection((HERE, served.port), timeout=10) as peer:
        peer.sendall(request)
        assert peer.recv(12) == b"HTTP/1.1 200"
        assert get(served) == 200  # others are served meanwhile
        until(lambda: not served.server.server_state.connections)


def test_there_are_so_many_connections_and_no_more(
    served: ServedPage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bounded_server, "MOST_OF_ONE_PEER", 8)
    with ExitStack() as held:
        peers = [
            held.enter_context(socket.create_connection((HERE, served.port), timeout=5))
            for _ in range(8)
        ]
        with pytest.raises((ConnectionError, http.client.HTTPException)):
            while True:  # until all eight have been accepted
                get(served)
        assert len(peers) == 8
    until(lambda: not served.server.server_state.connections)
    assert get(served) == 200


def test_who_asks_too_often_waits(served: ServedPage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gate, "REFUSED_S", 0.0)
    answers = [served.ask("GET", "/pair", peer=ELSEWHERE).status for _ in range(300)]
    assert answers[0] == 200 and answers[-1] == 429
    assert served.ask("GET", "/pair", peer=HERE, headers={"host": HERE}).status == 200
