"""Wires of the MAVLink link, over real sockets and pseudo-terminals."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import time
from collections.abc import AsyncIterator
from functools import partial
from pathlib import Path

import pytest

from drivers.mavlink.wire import tcp_wire
from drivers.mavlink.wire.link_url import Endpoint, link_endpoint
from drivers.mavlink.wire.send_queue import PacketQueue
from drivers.mavlink.wire.serial_wire import SerialWire
from drivers.mavlink.wire.tcp_wire import TcpWire
from drivers.mavlink.wire.transport import link_wire
from drivers.mavlink.wire.udp_wire import PEER_SILENT_NS, KernelStamps, UdpWire
from drivers.mavlink.wire.wire import STALLED_NS
from tests.support.autopilot.fake_wire import PtyWire, free_port
from tests.support.autopilot.mavlink_link import Ear, Speaker, running
from tests.support.processes.strain import within
from tests.support.processes.waits import RECLAIMS, Waits
from tests.support.waiting import PATIENCE_S
from tests.support.waiting_in_loop import until

HOST = "127.0.0.1"


def udp_socket() -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.bind((HOST, 0))
    made.setblocking(False)
    return made


def everything(end: socket.socket) -> list[bytes]:
    got = []
    while True:
        try:
            got.append(end.recv(65536))
        except BlockingIOError:
            return got


def has_packets(ear: Ear, n: int) -> bool:
    return len(ear.packets) == n


def listening() -> UdpWire:
    return UdpWire(Endpoint("udpin", HOST, 0), PacketQueue(64_000), listens=True)


# -- UDP -----------------------------------------------------------------------------------------


async def test_udp_both_ways() -> None:
    here, there = Ear(), Ear()
    port = free_port()
    listener = link_wire(link_endpoint(f"udpin:{HOST}:{port}"))
    caller = link_wire(link_endpoint(f"udpout:{HOST}:{port}"))
    packet = Speaker().attitude(1)
    async with running(listener.run(here)), running(caller.run(there)):
        await until(lambda: listener.connected and caller.connected)
        listener.write(b"nobody is there yet")
        caller.write(packet)
        await until(lambda: bytes(here.data) == packet)
        listener.write(packet * 2)
        await until(lambda: bytes(there.data) == packet * 2)
    assert (listener.n_dropped, caller.n_dropped) == (1, 0)
    assert not listener.connected


async def test_udp_is_stamped_when_it_comes_not_when_it_is_read() -> None:
    ear, wire = Ear(), listening()
    with udp_socket() as sender:
        async with running(wire.run(ear)):
            await until(lambda: wire.connected)
            packet, before_ns = Speaker().attitude(1), time.monotonic_ns()
            sender.sendto(packet, (HOST, wire.port))
            sent_ns = time.monotonic_ns()
            time.sleep(0.05)  # the loop is kept from reading
            await until(lambda: bool(ear.times_ns))
    assert before_ns - 1_000_000 < ear.times_ns[0] < sent_ns + 1_000_000


def test_kernel_stamps_are_not_used_across_a_change_of_the_clock(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stamps = KernelStamps()
    before_ns, came_ns, now_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
    stamped_ns = stamps.monotonic_ns(came_ns - 3_000_000)
    assert before_ns - 5_000_000 < stamped_ns < now_ns - 1_000_000
    real = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: real() + 3600 * 10**9)
    assert stamps.monotonic_ns(came_ns) >= now_ns
    later_ns = time.monotonic_ns()
    assert stamps.monotonic_ns(time.time_ns() - 3_000_000) < later_ns  # and then it is good again
    assert stamps.monotonic_ns(time.time_ns() - 10**10) >= later_ns
    assert stamps.monotonic_ns(None) >= later_ns


def test_kernel_stamps_are_used_where_reading_the_clocks_was_interrupted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stamps = KernelStamps()
    real, waits_s = time.time_ns, [0.01, 0.0]

    def interrupted() -> int:
        time.sleep(waits_s.pop(0) if waits_s else 0.0)
        return real()

    came_ns, now_ns = time.time_ns() - 3_000_000, time.monotonic_ns()
    monkeypatch.setattr(time, "time_ns", interrupted)
    assert stamps.monotonic_ns(came_ns) < now_ns


async def test_a_udp_listener_keeps_to_its_peer_until_that_is_silent() -> None:
    ear, wire = Ear(), listening()
    first, second = Speaker(1), Speaker(2)
    with udp_socket() as friend, udp_socket() as stranger:
        async with running(wire.run(ear)):
            await until(lambda: wire.connected)
            to = HOST, wire.port
            stranger.sendto(b"no MAVLink at all, so no peer", to)
            await until(lambda: wire.n_strange == 1)
            assert wire.peer is None
            friend.sendto(first.attitude(1), to)
            await until(lambda: wire.peer == friend.getsockname())
            stranger.sendto(second.attitude(2), to)
            await until(lambda: wire.n_strange == 2)
            assert {packet.system for packet in ear.packets} == {1}
            wire.write(b"x")
            await asyncio.sleep(0.01)
            assert (everything(friend), everything(stranger)) == ([b"x"], [])
            await asyncio.sleep(PEER_SILENT_NS * 1e-9)
            stranger.sendto(b"garbage does not take the link over", to)
            stranger.sendto(second.attitude(3), to)
            await until(lambda: wire.peer == stranger.getsockname())
            assert ear.packets[-1].system == 2


async def test_the_tap_hears_the_peer_of_a_udp_wire_and_no_stranger() -> None:
    tapped: list[tuple[bool, bytes]] = []
    wire, speaker = listening(), Speaker(1)
    wire.tap = lambda sent, data, _: tapped.append((sent, data))
    first, second = speaker.attitude(1), speaker.attitude(2)
    with udp_socket() as friend, udp_socket() as stranger:
        async with running(wire.run(Ear())):
            await until(lambda: wire.connected)
            to = HOST, wire.port
            stranger.sendto(b"no MAVLink at all, so no peer", to)
            friend.sendto(first, to)
            stranger.sendto(Speaker(2).attitude(1), to)
            friend.sendto(second, to)
            await until(lambda: len(tapped) >= 2 and wire.n_strange == 2)
            wire.write(b"x")
    assert tapped == [(False, first), (False, second), (True, b"x")]


async def test_a_udp_caller_listens_to_whom_it_calls_only() -> None:
    ear = Ear()
    with udp_socket() as friend, udp_socket() as stranger:
        wire = UdpWire(Endpoint("udpout", HOST, friend.getsockname()[1]), PacketQueue(64_000))
        async with running(wire.run(ear)):
            await until(lambda: wire.connected)
            wire.write(b"x")
            await asyncio.sleep(0.01)
            _, caller = friend.recvfrom(100)
            stranger.sendto(Speaker(2).attitude(1), caller)
            friend.sendto(Speaker(1).attitude(1), caller)
            await until(lambda: bool(ear.packets))
    assert [packet.system for packet in ear.packets] == [1]
    assert wire.n_strange == 1


async def test_a_port_that_is_taken_is_named_and_then_used() -> None:
    with udp_socket() as taken:
        wire = link_wire(link_endpoint(f"udpin:{HOST}:{taken.getsockname()[1]}"))
        async with running(wire.run(Ear())):
            await until(lambda: "in use" in wire.trouble)
            taken.close()
            await until(lambda: wire.connected)
            assert wire.trouble == ""


async def test_a_name_that_is_none_is_named() -> None:
    wire = link_wire(link_endpoint("udpout:no-such-host.invalid:1"))
    async with running(wire.run(Ear())):
        await until(lambda: "cannot be resolved" in wire.trouble)


# -- TCP -----------------------------------------------------------------------------------------


async def test_tcp_comes_back_by_itself() -> None:
    ear, speaker = Ear(), Speaker()
    port = free_port(socket.SOCK_STREAM)
    wire = TcpWire(Endpoint("tcp", HOST, port), PacketQueue(64_000))
    async with running(wire.run(ear)):
        await until(lambda: "refused" in wire.trouble.lower())
        for turn in (1, 2):
            with socket.create_server((HOST, port)) as server:
                server.setblocking(False)
                loop = asyncio.get_running_loop()
                with within(1.0):
                    client, _ = await loop.sock_accept(server)
                with client:
                    await loop.sock_sendall(client, speaker.attitude(turn)[:10])
                    await loop.sock_sendall(client, speaker.attitude(turn))
                    await until(partial(has_packets, ear, turn))
                    wire.write(b"answer")
                    assert await loop.sock_recv(client, 100) == b"answer"
            await until(lambda: not wire.connected)
            assert "closed" in wire.trouble
            wire.write(b"into the void")
    assert ear.n_opened == 2
    assert wire.n_dropped == 2


@contextlib.asynccontextmanager
async def taken() -> AsyncIterator[tuple[TcpWire, socket.socket, socket.socket]]:
    """A running wire that a server has taken; the server, and its end."""
    with socket.create_server((HOST, 0)) as server:
        server.setblocking(False)
        wire = TcpWire(Endpoint("tcp", HOST, server.getsockname()[1]), PacketQueue(64_000))
        async with running(wire.run(Ear())):
            client, _ = await asyncio.get_running_loop().sock_accept(server)
            with client:
                await until(lambda: wire.connected)
                yield wire, server, client


async def test_a_tcp_peer_that_never_reads_costs_the_oldest_and_no_time() -> None:
    async with taken() as (wire, _, client):
        waits, n_sent = Waits(), 20_000
        speaker = Speaker()
        for i in range(n_sent):
            packet = speaker.attitude(i)
            with waits:
                wire.write(packet)
        assert wire.queue.n_bytes <= 64_000
        assert wire.n_dropped > 0
        assert waits.n <= RECLAIMS
        assert waits.longest_busy_s < 0.05
        # what does come through is whole packets, the newest among them
        ear = Ear()
        client.setblocking(False)
        while not (ear.packets and ear.packets[-1].seq == (n_sent - 1) % 256):
            ear.received(await asyncio.get_running_loop().sock_recv(client, 65536), 0)
            await asyncio.sleep(0)
        assert ear.stream.n_bad_bytes == 0
        assert len(ear.packets) + wire.n_dropped == n_sent


async def test_a_wire_ends_whenever_it_is_cancelled() -> None:
    """A cancellation that came as the connection did was once swallowed."""
    with socket.create_server((HOST, 0), backlog=100) as server:
        endpoint = Endpoint("tcp", HOST, server.getsockname()[1])
        for n_turns in range(30):
            wire = TcpWire(endpoint, PacketQueue(64_000))
            task = asyncio.ensure_future(wire.run(Ear()))
            for _ in range(n_turns):
                await asyncio.sleep(0)
            task.cancel()
            await asyncio.wait({task}, timeout=PATIENCE_S)
            assert task.cancelled()
            assert not wire.connected


async def test_a_tcp_peer_that_answers_no_call_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tcp_wire, "CONNECT_S", 0.05)
    with socket.create_server((HOST, 0), backlog=0) as server, contextlib.ExitStack() as ends:
        for _ in range(3):  # until its backlog is full
            queued = ends.enter_context(socket.socket())
            queued.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                queued.connect(server.getsockname())
        wire = TcpWire(Endpoint("tcp", HOST, server.getsockname()[1]), PacketQueue(64_000))
        async with running(wire.run(Ear())):
            await until(lambda: "no answer" in wire.trouble)


async def test_a_tcp_peer_that_reads_nothing_for_long_is_given_up() -> None:
    async with taken() as (wire, server, _):
        while not wire.queue:
            wire.write(bytes(10_000))
        wire.write(b"not so soon")
        assert wire.connected
        wire._progress_ns -= STALLED_NS
        wire.write(b"now")
        assert not wire.connected
        await until(lambda: wire.trouble != "")
        assert "nothing was taken for 30 s" in wire.trouble
        again, _ = await asyncio.get_running_loop().sock_accept(server)
        again.close()


# -- serial --------------------------------------------------------------------------------------


async def test_a_serial_line_both_ways_unplugged_and_back(tmp_path: Path) -> None:
    cable = PtyWire(tmp_path / "autopilot")
    ear, speaker = Ear(), Speaker()
    wire = link_wire(link_endpoint(f"serial:{cable.link}:115200"))
    async with running(wire.run(ear)):
        await until(lambda: "not there; is the autopilot plugged in" in wire.trouble)
        for turn in (1, 2, 3):
            with within(1.0):
                cable.plug()
                await until(lambda: wire.connected)
            cable.send(speaker.attitude(turn)[:-4])  # half a packet, of before the pulling
            cable.send(speaker.attitude(turn))
            await until(partial(has_packets, ear, turn))
            wire.write(b"to the autopilot")
            await asyncio.sleep(0.01)
            assert cable.receive() == [b"to the autopilot"]
            cable.send(speaker.attitude(turn)[:10])
            await asyncio.sleep(0.01)
            cable.unplug()
            await until(lambda: not wire.connected)
    assert [packet.message_id for packet in ear.packets] == [30, 30, 30]
    assert ear.n_opened == 3


async def test_a_serial_line_has_one_owner(tmp_path: Path) -> None:
    cable = PtyWire(tmp_path / "autopilot")
    cable.plug()
    first, second = (SerialWire(link_endpoint(f"serial:{cable.link}:57600")) for _ in "12")
    async with running(first.run(Ear())) as owning:
        await until(lambda: first.connected)
        async with running(second.run(Ear())):
            await until(lambda: "in use by another program" in second.trouble)
            owning.cancel()
            await until(lambda: second.connected)
    cable.unplug()


async def test_what_is_no_serial_line_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    wire = link_wire(link_endpoint(f"serial:{tmp_path / 'file'}:57600"))
    async with running(wire.run(Ear())):
        await until(lambda: str(tmp_path / "file") in wire.trouble)
    assert not wire.connected


@pytest.mark.real_time
async def test_a_serial_line_that_takes_nothing_costs_the_oldest_and_no_time(
    tmp_path: Path,
) -> None:
    cable = PtyWire(tmp_path / "autopilot")
    cable.plug()
    wire = link_wire(link_endpoint(f"serial:{cable.link}:921600"))
    ear, speaker = Ear(), Speaker()
    async with running(wire.run(ear)):
        await until(lambda: wire.connected)
        waits = Waits()
        for i in range(5000):
            packet = speaker.attitude(i)
            with waits:
                wire.write(packet)
        assert waits.n <= RECLAIMS
        assert waits.busy_s < 1
        assert wire.n_dropped > 3000
        assert wire.queue.n_bytes <= 0.25 * 92_160
        # once it is read again everything goes on, without half a packet
        got = Ear()
        while not (got.packets and got.packets[-1].seq == 4999 % 256):
            for data in cable.receive():
                got.received(data, 0)
            await asyncio.sleep(0.001)
        assert got.stream.n_bad_bytes == 0
        cable.send(speaker.heartbeat())
        await until(lambda: len(ear.packets) == 1)
    cable.unplug()


@pytest.mark.parametrize("baud", [921600, 57600, 115200, 460800, 230400, 1500000])
async def test_the_baud_rate_is_found(tmp_path: Path, baud: int) -> None:
    """No pty minds a speed; this one makes rubbish of all bytes until the true one is set."""
    cable = PtyWire(tmp_path / "autopilot", baud)
    cable.plug()
    ear, speaker = Ear(), Speaker()
    wire = SerialWire(link_endpoint(f"serial:{cable.link}:auto"))
    async with running(wire.run(ear)):
        for i in range(2000):
            cable.send(speaker.attitude(i))
            await asyncio.sleep(0.002)
            if wire.search.found:
                break
        assert wire.search.found
        assert wire.search.baud == baud
        assert wire.bytes_per_s == baud / 10
        assert wire.trouble == ""
        cable.unplug()
        await until(lambda: not wire.connected)
        cable.plug()
        await until(lambda: wire.connected)
        n_before = len(ear.packets)
        cable.send(speaker.attitude(1))
        await until(lambda: len(ear.packets) == n_before + 1)  # at once at the rate of before
    cable.unplug()


async def test_a_wrong_baud_rate_is_named(tmp_path: Path) -> None:
    cable = PtyWire(tmp_path / "autopilot", 57600)
    cable.plug()
    wire = SerialWire(link_endpoint(f"serial:{cable.link}:115200"))
    wire.search.begin(time.monotonic_ns())
    async with running(wire.run(Ear())):
        await until(lambda: wire.connected)
        wire.search._since_ns -= 3 * 10**9
        for i in range(100):
            cable.send(Speaker().attitude(i))
        await until(lambda: "no MAVLink at 115200 baud" in wire.trouble)
    cable.unplug()


@pytest.mark.real_time
async def test_closing_does_not_wait_for_a_line_that_takes_nothing(tmp_path: Path) -> None:
    cable = PtyWire(tmp_path / "autopilot")
    cable.plug()
    wire = link_wire(link_endpoint(f"serial:{cable.link}:57600"))
    n_files = len(os.listdir("/proc/self/fd"))
    async with running(wire.run(Ear())):
        await until(lambda: wire.connected)
        for _ in range(1000):
            wire.write(bytes(280))
        begun_s = time.monotonic()
    assert time.monotonic() - begun_s < 0.2
    assert len(os.listdir("/proc/self/fd")) == n_files
    cable.unplug()
