from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import pytest

from companion.errors import StreamError
from companion.streaming.exporter import Exporter, open_listener
from companion.streaming.framing import HELLO, MOST_ITEM_BYTES, Reassembly, frame, hello_datagram
from companion.streaming.ground_link import GroundLink, host_and_port
from companion.streaming.item_codec import Kind, decode
from companion.streaming.item_store import ItemStore
from companion.streaming.items import COARSE, FlightItem, Item, PointsItem, PoseItem, Shown
from companion.streaming.parts import parts_of
from tests.support.waiting import until
from tests.unit.streaming.test_stream_session import add_points, filled
from tests.unit.streaming.test_viewer_recording import CAMERA


@contextmanager
def serving(
    store: ItemStore, budget_kbit_s: float = 0, most: int = 4
) -> Iterator[tuple[Exporter, int]]:
    exporter = Exporter(store, most, budget_kbit_s)
    listener = open_listener("127.0.0.1:0")
    exporter.listen(listener)
    thread = threading.Thread(target=exporter.run)
    thread.start()
    try:
        yield exporter, listener.getsockname()[1]
    finally:
        exporter.stop()
        thread.join(60)
        listener.close()
        assert not thread.is_alive()


@dataclass
class Watching:
    """Somebody who looks on."""

    link: GroundLink
    items: list[Item] = field(default_factory=list)
    told: list[str] = field(default_factory=list)
    may_take: threading.Event = field(default_factory=threading.Event)

    def coarse(self) -> set[int]:
        points = [i for i in self.items if isinstance(i, PointsItem)]
        return {i.keyframe_id for i in points if i.level == COARSE}


@contextmanager
def watching(port: int) -> Iterator[Watching]:
    told: list[str] = []
    viewer = Watching(GroundLink("127.0.0.1", port, told.append), told=told)
    viewer.may_take.set()
    stop = threading.Event()

    def work() -> None:
        for item in viewer.link.items(stop):
            viewer.items.append(item)
            viewer.may_take.wait(20)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield viewer
    finally:
        viewer.may_take.set()
        stop.set()
        thread.join(60)
        assert not thread.is_alive()


def pose(t_ns: int) -> PoseItem:
    return PoseItem(t_ns, Shown.TRACKING)


def tell(exporter: Exporter, item: Item) -> None:
    exporter.take(item, parts_of(item))


def test_two_viewers_see_the_same_and_one_who_comes_late_sees_it_all() -> None:
    with serving(filled(30)) as (exporter, port), watching(port) as first:
        until(lambda: len(first.coarse()) == 30)
        with watching(port) as second:
            until(lambda: len(second.coarse()) == 30)
            tell(exporter, pose(5))
            for viewer in (first, second):
                until(lambda: any(isinstance(i, PoseItem) and i.t_ns == 5 for i in viewer.items))  # noqa: B023
                assert isinstance(viewer.items[0], FlightItem)
                assert viewer.items[0].camera.fx == CAMERA.fx
            assert exporter.report()["viewers"] == 2
        until(lambda: exporter.report()["viewers"] == 1)
        until(exporter.is_drained)


def test_a_viewer_that_connects_again_is_not_sent_the_map_again() -> None:
    with serving(filled(30)) as (exporter, port), watching(port) as viewer:
        until(lambda: len(viewer.coarse()) == 30)
        until(exporter.is_drained)
        n = len(viewer.items)
        for connection in exporter._connections:
            connection.socket.shutdown(socket.SHUT_RDWR)
        until(lambda: viewer.link.n_connections == 2)
        add_points(exporter._store, 77)
        exporter._wake_up()
        until(lambda: 77 in viewer.coarse())
        again = [i.keyframe_id for i in viewer.items[n:] if isinstance(i, PointsItem)]
        assert set(again) == {77}
        assert any("is lost" in text for text in viewer.told)
    before = exporter.report()["skipped"]
    for t_ns in range(50):
        tell(exporter, pose(t_ns))
    assert exporter.report()["skipped"] == before  # nobody looks on


@pytest.mark.real_time
def test_a_viewer_that_stands_still_costs_the_others_nothing_and_catches_up() -> None:
    with serving(filled(200)) as (exporter, port), watching(port) as slow, watching(port) as quick:
        slow.may_take.clear()
        until(lambda: len(quick.coarse()) == 200)
        assert len(slow.items) < 50
        for t_ns in range(100):
            began = time.perf_counter()
            tell(exporter, pose(t_ns))
            assert time.perf_counter() - began < 0.5
            time.sleep(0.002)
        until(lambda: any(isinstance(i, PoseItem) and i.t_ns == 99 for i in quick.items))
        slow.may_take.set()
        until(lambda: len(slow.coarse()) == 200)
        until(lambda: any(isinstance(i, PoseItem) and i.t_ns == 99 for i in slow.items))


def test_poses_come_by_datagrams_and_in_order() -> None:
    with serving(filled(1)) as (exporter, port), watching(port) as viewer:
        until(lambda: viewer.items)
        t_ns = 0

        def flying() -> bool:
            nonlocal t_ns
            t_ns += 1
            tell(exporter, pose(t_ns))
            time.sleep(0.02)
            return viewer.link.n_datagrams > 20

        until(flying)
        seen = [item.t_ns for item in viewer.items if isinstance(item, PoseItem)]
        assert seen == sorted(set(seen))


def test_datagrams_go_to_nobody_who_is_not_connected() -> None:
    with serving(filled(1)) as (exporter, port):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.settimeout(0.5)
            stranger.sendto(hello_datagram(bytes(16), 1), ("127.0.0.1", port))
            stranger.sendto(b"x" * 300, ("127.0.0.1", port))
            tell(exporter, pose(1))
            with pytest.raises(TimeoutError):
                stranger.recv(100)


@pytest.mark.real_time
def test_the_budget_holds_headers_and_all() -> None:
    with serving(filled(100), budget_kbit_s=800) as (_, port), watching(port) as viewer:
        until(lambda: viewer.link.n_bytes > 20_000)
        began, n = time.perf_counter(), viewer.link.n_bytes
        time.sleep(1.5)
        rate = (viewer.link.n_bytes - n) / (time.perf_counter() - began)
        assert 40_000 < rate < 105_000  # of 100 000 bytes/s


def test_a_peer_that_is_no_viewer_is_rejected_and_so_is_one_too_many() -> None:
    with serving(filled(1), most=1) as (exporter, port):
        with socket.create_connection(("127.0.0.1", port), timeout=5) as stranger:
            stranger.sendall(b"GET / HTTP/1.1\r\n\r\n")
            assert stranger.recv(100) == b""
        with watching(port) as first:
            until(lambda: first.items)
            with socket.create_connection(("127.0.0.1", port), timeout=5) as another:
                another.sendall(HELLO + bytes(16))
                assert another.recv(100) == b""
            assert exporter.n_refused == 1


def test_a_drone_that_is_not_there_is_waited_for() -> None:
    with open_listener("127.0.0.1:0") as nobody:
        port = nobody.getsockname()[1]
    with watching(port) as viewer:
        until(lambda: viewer.told)
        assert viewer.told[0].startswith(f"waiting for 127.0.0.1:{port}")


def test_items_come_back_whatever_the_pieces_and_what_is_too_large_is_refused() -> None:
    data = frame(2, b"ab", False) + frame(8, b"xyz", False) + frame(2, b"c", True)
    data += frame(0, b"", True) + frame(8, b"!", True)
    for n in (1, 2, 5, len(data)):
        parts = Reassembly()
        got = [item for at in range(0, len(data), n) for item in parts.take(data[at : at + n])]
        assert got == [(2, b"abc"), (0, b""), (8, b"xyz!")]
    flood = Reassembly()
    with pytest.raises(StreamError, match="too large"):
        for _ in range(MOST_ITEM_BYTES // 60_000 + 2):
            flood.take(frame(8, bytes(60_000), False))


@pytest.mark.parametrize(
    "text, wanted",
    [("drone", ("drone", 9870)), ("10.0.0.1:99", ("10.0.0.1", 99)), ("[::1]:7", ("::1", 7)),
     ("[fe80::1]", ("fe80::1", 9870))],
)  # fmt: skip
def test_a_host_may_have_a_port(text: str, wanted: tuple[str, int]) -> None:
    assert host_and_port(text) == wanted


@pytest.mark.parametrize("text", ["", ":9870", "drone:", "drone:x", "drone:70000", "/x"])
def test_what_is_no_host_is_refused(text: str) -> None:
    with pytest.raises(StreamError, match="wanted HOST"):
        host_and_port(text)


def test_numbers_that_are_no_numbers_are_refused() -> None:
    for kind in Kind:
        with pytest.raises(StreamError):
            decode(kind, b"\x01")
    random = np.random.default_rng(3)
    for _ in range(500):
        try:
            decode(int(random.integers(0, 20)), random.bytes(int(random.integers(0, 80))))
        except StreamError:
            pass
