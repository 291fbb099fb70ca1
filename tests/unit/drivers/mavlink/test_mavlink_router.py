"""The router, with an autopilot and clients on real sockets."""

from __future__ import annotations

import asyncio
import contextlib
import random
import socket
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.errors import ConfigError
from drivers.mavlink.wire.packet_stream import MavlinkStream, Packet
from drivers.mavlink.wire.pymavlink_port import PymavlinkPort
from drivers.mavlink.wire.router import MOST_GARBAGE
from drivers.mavlink.wire.tcp_listener import MOST_CONNECTIONS
from tests.support.autopilot.fake_wire import PtyWire, free_port
from tests.support.autopilot.mavlink_link import (
    Heard,
    Speaker,
    attitude,
    command,
    heartbeat,
    port_at,
    running,
    split,
    unknown,
)
from tests.support.waiting_in_loop import until

HOST = "127.0.0.1"


@dataclass
class Side:
    """Somebody at the other end of a socket: the autopilot, or a client."""

    socket: socket.socket
    address: tuple[str, int] | None = None
    stream: MavlinkStream = field(default_factory=MavlinkStream)
    got: list[Packet] = field(default_factory=list)

    def send(self, data: bytes) -> None:
        if self.address is None:
            self.socket.send(data)
        else:
            self.socket.sendto(data, self.address)

    def hear(self) -> list[Packet]:
        """All that has come so far."""
        with contextlib.suppress(BlockingIOError):
            while data := self.socket.recv(65536):
                self.got += self.stream.feed(data, 0)
        assert self.stream.n_bad_bytes == 0
        return self.got

    def heard(self, raw: bytes) -> bool:
        return any(packet.raw == raw for packet in self.hear())


def udp(address: tuple[str, int] | None = None) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.bind(address or (HOST, 0))
    made.setblocking(False)
    return made


@dataclass
class Scene:
    """An autopilot on UDP, a port with a router, and places for clients."""

    port: PymavlinkPort
    autopilot: Side
    heard: Heard
    tcp_port: int
    udp_port: int
    ends: contextlib.ExitStack

    async def tcp_client(self) -> Side:
        made = self.ends.enter_context(socket.socket())
        made.setblocking(False)
        await asyncio.get_running_loop().sock_connect(made, (HOST, self.tcp_port))
        n_before = len(self.port.router.counts())
        with contextlib.suppress(AssertionError):
            await until(lambda: len(self.port.router.counts()) > n_before, 0.06)
        return Side(made)

    def udp_client(self) -> Side:
        return Side(self.ends.enter_context(udp()), (HOST, self.udp_port))


@contextlib.asynccontextmanager
async def flown(queue_kb: int = 256, key_file: str = "") -> AsyncIterator[Scene]:
    with contextlib.ExitStack() as ends:
        autopilot = ends.enter_context(udp())
        tcp_port, udp_port = free_port(socket.SOCK_STREAM), free_port()
        port = port_at(
            f"udpout:{HOST}:{autopilot.getsockname()[1]}",
            (f"tcpin::{tcp_port}", f"udpin::{udp_port}"),
            queue_kb,
            key_file,
        )
        heard = Heard()
        async with running(port.run(heard)):
            await until(lambda: port.connected)
            port.send(heartbeat())
            await asyncio.sleep(0.02)
            _, us = autopilot.recvfrom(1000)
            side = Side(autopilot, us)
            yield Scene(port, side, heard, tcp_port, udp_port, ends)


def counts(scene: Scene, wanted: str) -> int:
    return sum(getattr(each, wanted) for each in scene.port.router.counts())


async def test_what_each_side_says_goes_where_it_should() -> None:
    async with flown() as scene:
        ground, udp_ground = await scene.tcp_client(), scene.udp_client()
        udp_ground.send(Speaker(254, 190).heartbeat())  # so that it is known
        autopilot, gimbal = Speaker(1, 1), Speaker(1, 154)
        other = Speaker(42, 1)
        await until(lambda: len(scene.autopilot.hear()) == 1)
        said = [autopilot.attitude(5), gimbal.heartbeat(), other.attitude(6), unknown(7)]
        scene.autopilot.send(b"".join(said))
        await until(lambda: all(ground.heard(raw) and udp_ground.heard(raw) for raw in said))
        await until(lambda: len(scene.heard.messages) == 3)
        assert [m.get_srcSystem() for m in scene.heard.messages] == [1, 1, 42]
        # from us to all
        scene.port.send(attitude(9))
        await until(lambda: scene.autopilot.hear()[-1].message_id == 30)
        ours = scene.autopilot.hear()[-1]
        assert (ours.system, ours.component) == (1, 197)
        await until(lambda: ground.heard(ours.raw) and udp_ground.heard(ours.raw))
        # from a client to the autopilot, and not to the other client or to us
        asked = Speaker(255, 190).pack(command(1, 1))
        ground.send(asked + unknown(8))
        await until(lambda: scene.autopilot.heard(asked) and scene.autopilot.heard(unknown(8)))
        assert not udp_ground.heard(asked)
        assert len(scene.heard.messages) == 3


async def test_what_a_client_asks_of_us_comes_to_us() -> None:
    async with flown() as scene:
        client, speaker = await scene.tcp_client(), Speaker(255, 190)
        to_us, to_all = speaker.pack(command(1, 197)), speaker.pack(command(1, 0))
        client.send(to_us + to_all + speaker.heartbeat())
        await until(lambda: len(scene.autopilot.hear()) == 2)
        assert scene.autopilot.heard(to_all)
        assert not scene.autopilot.heard(to_us)
        assert [m.get_type() for m in scene.heard.messages] == ["COMMAND_LONG"] * 2
        scene.port.identity = (1, 191)
        client.send(speaker.pack(command(1, 197)))
        await until(lambda: len(scene.autopilot.hear()) == 3)
        assert len(scene.heard.messages) == 2


async def test_packets_do_not_go_in_circles() -> None:
    async with flown() as scene:
        first, second = await scene.tcp_client(), await scene.tcp_client()
        telling = Speaker(1, 154).heartbeat()
        scene.autopilot.send(telling)
        await until(lambda: first.heard(telling) and second.heard(telling))
        first.send(telling)  # what it got, sent back
        ground = Speaker(255, 190).heartbeat()
        first.send(ground)
        second.send(ground)  # the same from two, who are joined elsewhere
        second.send(Speaker(1, 197).heartbeat())  # us
        scene.autopilot.send(Speaker(1, 1).heartbeat())
        await until(lambda: len(scene.heard.messages) == 2)
        second.send(Speaker(1, 1).pack(command(1, 197)))  # the autopilot's name
        await until(lambda: counts(scene, "n_refused") == 4)
        assert [packet.raw for packet in scene.autopilot.hear()] == [ground]
        scene.autopilot.send(Speaker(1, 197).attitude(3))  # an echo
        await asyncio.sleep(0.02)
        assert not any(packet.component == 197 for packet in first.hear())
        assert len(scene.heard.messages) == 2
        scene.autopilot.send(Speaker(1, 197).heartbeat())  # an echo, or another companion
        await until(lambda: len(scene.heard.messages) == 3)
        assert not any(packet.component == 197 for packet in first.hear())


async def test_clients_may_ask_the_autopilot_the_time_but_not_tell_it_theirs() -> None:
    async with flown() as scene:
        client, speaker = await scene.tcp_client(), Speaker(255, 190)
        question = mavlink.MAVLink_timesync_message(0, 12345)
        for v1 in (False, True):
            client.send(speaker.pack(mavlink.MAVLink_timesync_message(7, 12345), v1=v1))
            client.send(speaker.pack(question, v1=v1))
        await until(lambda: counts(scene, "n_refused") == 2)
        await until(lambda: len(scene.autopilot.hear()) == 2)


async def test_a_client_that_repeats_itself_is_heard() -> None:
    async with flown() as scene:
        client = await scene.tcp_client()
        await scene.tcp_client()
        constant = Speaker(255, 190).heartbeat()
        for _ in range(5):
            client.send(constant)
        await until(lambda: len(scene.autopilot.hear()) == 5)


async def test_garbage_never_reaches_the_autopilot_and_ends_the_connection() -> None:
    noise = random.Random(3)
    async with flown() as scene:
        bad, good = await scene.tcp_client(), await scene.tcp_client()
        speaker = Speaker(255, 190)
        packet = speaker.heartbeat()
        damaged = bytearray(speaker.pack(command(1, 1)))
        damaged[20] ^= 1
        good.send(b"\xfd\xff\x00junk" + packet[:7] + packet + bytes(damaged) + b"\xfe\x09")
        await asyncio.sleep(0.15)
        later = speaker.heartbeat()
        good.send(later)
        await until(lambda: scene.autopilot.heard(later))
        with contextlib.suppress(OSError):
            for _ in range(300):
                bad.send(noise.randbytes(1000))
                await asyncio.sleep(0.005)
        await until(lambda: len(scene.port.router.counts()) == 2)  # `good` and the UDP place
        told = [each for each in scene.port.clients() if not each.connected]
        assert max(each.n_bad_bytes for each in told) > MOST_GARBAGE  # after it has gone
        assert len(scene.port.clients()) == 2
        assert [each.raw for each in scene.autopilot.hear()] == [packet, later]


async def steady(scene: Scene, other: Side, seconds: float = 0.5) -> list[float]:
    """Latencies of 100 messages a second to and from the autopilot, in s, while things happen."""
    speaker, latencies = Speaker(1, 1), []
    n_before = len(scene.heard.of("ATTITUDE"))
    for i in range(round(seconds * 100)):
        scene.autopilot.send(speaker.attitude(i))
        sent_ns = time.time_ns()
        await asyncio.sleep(0.01)
        scene.port.send(attitude(10_000 + i))
        attitudes = scene.heard.of("ATTITUDE")
        if len(attitudes) > n_before + i:
            latencies.append((scene.heard.times_ns[-1] - sent_ns) * 1e-9)
        scene.autopilot.hear()
        other.hear()
    n_expected = round(seconds * 100)

    def came() -> tuple[int, int, int]:
        """Attitudes: to us, ours to the autopilot, and all of both to the other client."""
        ours = [p for p in scene.autopilot.hear() if p.message_id == 30 and p.component == 197]
        n_other = sum(p.message_id == 30 for p in other.hear())
        return len(scene.heard.of("ATTITUDE")) - n_before, len(ours), n_other

    await until(lambda: min(came()) >= n_expected and came()[2] >= 2 * n_expected)
    assert came() == (n_expected, n_expected, 2 * n_expected)
    assert scene.port.n_dropped == 0
    return latencies


def test_a_client_that_never_reads_costs_only_itself() -> None:
    async def play() -> None:
        async with flown(queue_kb=4) as scene:
            await scene.tcp_client()
            good = await scene.tcp_client()
            speaker = Speaker(1, 154)
            for i in range(20_000):  # until all that may wait for the first one does
                scene.autopilot.send(speaker.attitude(i))
                if i % 50 == 0:
                    await asyncio.sleep(0)
                    good.hear()
            await steady_after(scene, good)
            dropped = sorted(each.n_dropped_out for each in scene.port.router.counts())
            assert dropped[-1] > 100

    async def steady_after(scene: Scene, good: Side) -> None:
        await until(lambda: len(scene.heard.messages) > 1000)
        await asyncio.sleep(0.1)
        good.hear()
        good.got.clear()
        scene.autopilot.hear()
        scene.autopilot.got.clear()
        await steady(scene, good)

    asyncio.run(play())


def flood(client: Side, speaker: Speaker) -> Callable[[], None]:
    """Sends as much as the socket takes whenever it is called."""

    def more() -> None:
        with contextlib.suppress(BlockingIOError):
            for _ in range(300):
                client.send(speaker.pack(command(1, 1)))

    return more


@pytest.mark.real_time
async def test_clients_that_flood_starve_neither_us_nor_another(tmp_path: Path) -> None:
    """Over a slow line: clients have to share what we leave of it."""
    cable = PtyWire(tmp_path / "autopilot")
    cable.plug()
    tcp_port, udp_port = free_port(socket.SOCK_STREAM), free_port()
    port = port_at(f"serial:{cable.link}:57600", (f"tcpin::{tcp_port}", f"udpin::{udp_port}"))
    heard, got, stream = Heard(), list[Packet](), MavlinkStream()
    with contextlib.ExitStack() as ends:
        async with running(port.run(heard)):
            await until(lambda: port.connected and not port.trouble)
            nobody = Side(ends.enter_context(udp()))
            scene = Scene(port, nobody, heard, tcp_port, udp_port, ends)
            modest = await scene.tcp_client()
            floods = []
            for i, client in enumerate([await scene.tcp_client(), scene.udp_client()]):
                speaker = Speaker(200 + i, 190)
                floods.append(flood(client, speaker))
            ground, n_said = Speaker(255, 190), 0
            begun_s = time.monotonic()
            n_turned_away = 0
            while (passed_s := time.monotonic() - begun_s) < 1.0 or n_turned_away <= 100:
                n_turned_away = counts(scene, "n_dropped_in")
                for more in floods:
                    more()
                if passed_s * 20 > n_said:
                    modest.send(ground.heartbeat())
                    port.send(attitude(n_said))
                    n_said += 1
                await asyncio.sleep(0.005)
                for data in cable.receive():
                    got += stream.feed(data, 0)
            await asyncio.sleep(0.1)
            for data in cable.receive():
                got += stream.feed(data, 0)
            read_s = time.monotonic() - begun_s
            sources = [packet.system for packet in got]
            assert sources.count(1) == n_said  # all of ours
            assert sources.count(255) >= n_said - 4  # and the other client's
            for flooder in (200, 201):
                assert sources.count(flooder) > 5
            n_bytes = sum(len(packet.raw) for packet in got)
            assert n_bytes < 5760 * (read_s + 0.15)
            assert port.n_dropped == 0
            assert stream.n_bad_bytes == 0
    cable.unplug()


@pytest.mark.real_time
async def test_a_thousand_connections_leave_nothing_behind() -> None:
    async with flown() as scene:
        good = await scene.tcp_client()
        good.send(Speaker(255, 190).heartbeat())
        await until(lambda: len(scene.autopilot.hear()) == 1)
        address = HOST, scene.tcp_port

        async def attack() -> None:
            for i in range(1000):
                with socket.socket() as one:
                    one.setblocking(False)
                    with contextlib.suppress(OSError):
                        one.connect(address)
                if i % 20 == 0:
                    await asyncio.sleep(0.01)

        async with running(attack()) as attacking:
            latencies = await steady(scene, good)
            await attacking
        assert sorted(latencies)[len(latencies) // 2] < 0.005
        assert len(scene.port.router.counts()) <= MOST_CONNECTIONS + 1


async def test_an_idle_connection_is_closed_for_a_new_one() -> None:
    async with flown() as scene:
        clients = [await scene.tcp_client() for _ in range(MOST_CONNECTIONS)]
        clients[0].send(Speaker(255, 190).heartbeat())
        await until(lambda: len(scene.autopilot.hear()) == 1)
        late = await scene.tcp_client()
        await until(lambda: scene.port.router.n_rejected == 1)
        packet = Speaker(1, 1).attitude(1)
        await asyncio.sleep(0.05)
        scene.autopilot.send(packet)
        await until(lambda: clients[0].heard(packet) and late.heard(packet))
        with contextlib.suppress(BlockingIOError):
            assert clients[1].socket.recv(1000) == b""


async def test_clients_that_come_before_the_autopilot_are_there_when_it_comes(
    tmp_path: Path,
) -> None:
    cable = PtyWire(tmp_path / "autopilot")
    tcp_port = free_port(socket.SOCK_STREAM)
    port = port_at(f"serial:{cable.link}:57600", (f"tcpin::{tcp_port}",))
    with contextlib.ExitStack() as ends:
        async with running(port.run(Heard())):
            scene = Scene(port, Side(ends.enter_context(udp())), Heard(), tcp_port, 0, ends)
            await until(lambda: port.router._listeners[0].port != 0)
            client = await scene.tcp_client()
            client.send(Speaker(255, 190).heartbeat())
            await until(lambda: port.n_dropped == 1)
            cable.plug()
            await until(lambda: port.connected)
            packet = Speaker(1, 1).attitude(1)
            cable.send(packet)
            await until(lambda: client.heard(packet))
    cable.unplug()


async def test_a_place_that_is_taken_is_named_and_the_rest_works() -> None:
    with udp() as taken:
        scene_port = taken.getsockname()[1]
        port = port_at(f"udpin:{HOST}:{free_port()}", (f"udpin::{scene_port}",))
        async with running(port.run(Heard())):
            await until(lambda: f"udpin:{HOST}:{scene_port}: Address already" in port.trouble)
            assert port.connected


def test_clients_that_are_none_are_refused() -> None:
    with pytest.raises(ConfigError, match=r'^router\.clients: "tcp:1.2.3.4:5" must begin with'):
        port_at("udpin::14550", ("tcp:1.2.3.4:5",))


async def test_with_a_key_clients_must_sign_too(tmp_path: Path) -> None:
    key = bytes(range(32))
    (tmp_path / "key").write_text(key.hex())
    async with flown(key_file=str(tmp_path / "key")) as scene:
        client = await scene.tcp_client()
        client.send(Speaker(255, 190).heartbeat())
        await until(lambda: counts(scene, "n_refused") == 1)
        stamp = (time.time_ns() - 1_420_070_400 * 10**9) // 10_000
        packet = Speaker(255, 190, key).pack(heartbeat(), stamp)
        client.send(packet)
        await until(lambda: [p.raw for p in scene.autopilot.hear()] == [packet])
        # what the autopilot says is the clients' own to judge
        unsigned = Speaker(1, 1).heartbeat()
        scene.autopilot.send(unsigned)
        await until(lambda: client.heard(unsigned))
        assert scene.heard.messages == []
        assert (scene.port.n_unsigned, scene.port.n_bad) == (1, 1)


def test_splitting_fails_on_what_is_no_packet() -> None:
    with pytest.raises(AssertionError):
        split(b"x" + Speaker().heartbeat())
