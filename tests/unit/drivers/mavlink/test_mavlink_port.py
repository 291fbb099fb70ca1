"""MAVLink port with an autopilot that speaks real MAVLink."""

from __future__ import annotations

import asyncio
import random
import socket
import time
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.errors import ConfigError
from companion.timing.clock import FlightClock
from tests.support.autopilot.fake_autopilot import FakeAutopilot
from tests.support.autopilot.fake_wire import PtyWire
from tests.support.autopilot.mavlink_link import (
    Heard,
    Speaker,
    attitude,
    heartbeat,
    port_at,
    running,
    unknown,
)
from tests.support.waiting import PATIENCE_S
from tests.support.waiting_in_loop import until

HOST = "127.0.0.1"
KEY = bytes(range(100, 132))


@pytest.mark.parametrize("kind", ["udpin", "udpout", "tcpin", "pty"])
async def test_an_autopilot_on_any_wire(tmp_path: Path, kind: str) -> None:
    place = f"{tmp_path}/autopilot" if kind == "pty" else f"{HOST}:0"
    with FakeAutopilot("px4", f"{kind}:{place}") as autopilot:
        port = port_at(autopilot.url.replace(":auto", ":57600"))
        heard = Heard()
        async with running(port.run(heard)):
            await until(lambda: port.connected)
            if kind == "udpout":
                await until(lambda: port.n_received > 0)
            port.send(heartbeat())
            await until(lambda: bool(heard.of("HEARTBEAT")) and len(heard.of("ATTITUDE")) > 5)
            autopilot.wait_for("HEARTBEAT", 1, PATIENCE_S)
            message = autopilot.of("HEARTBEAT")[0]
            assert (message.system, message.component) == (1, 197)
            assert port.n_bad == 0
        assert not port.connected


@pytest.mark.parametrize("kind", ["udpin", "tcpin", "pty"])
async def test_a_tap_hears_every_byte_both_ways(tmp_path: Path, kind: str) -> None:
    tapped: list[tuple[bool, bytes, int]] = []
    place = f"{tmp_path}/autopilot" if kind == "pty" else f"{HOST}:0"
    with FakeAutopilot("px4", f"{kind}:{place}") as autopilot:
        port = port_at(autopilot.url.replace(":auto", ":57600"))
        port.set_tap(lambda out, data, ns: tapped.append((out, data, ns)))
        heard = Heard()
        async with running(port.run(heard)):
            await until(lambda: port.connected)
            while not autopilot.of("ATTITUDE") or len(heard.of("ATTITUDE")) < 5:
                port.send(attitude(1))
                await asyncio.sleep(0.02)
        n_heard = port.n_received
    began = {out: b"".join(d for o, d, _ in tapped if o is out) for out in (False, True)}
    codec = mavlink.MAVLink(None)
    assert len(codec.parse_buffer(began[False]) or []) == n_heard
    sent = mavlink.MAVLink(None).parse_buffer(began[True])
    assert len(sent or []) == port.n_sent and {m.get_type() for m in sent} == {"ATTITUDE"}
    stamps = [ns for _, _, ns in tapped]
    assert max(stamps) <= time.monotonic_ns() and max(stamps) - min(stamps) < 60e9


async def test_the_wire_pulled_and_plugged_again(tmp_path: Path) -> None:
    with FakeAutopilot("px4", f"pty:{tmp_path}/autopilot") as autopilot:
        port, heard = port_at(f"serial:{tmp_path}/autopilot:57600"), Heard()
        async with running(port.run(heard)):
            for _ in range(2):
                await until(lambda: port.connected)
                heard.messages.clear()
                await until(lambda: len(heard.messages) > 3)
                autopilot.unplug()
                await until(lambda: not port.connected)
                port.send(heartbeat())
                autopilot.plug()
            assert port.n_dropped == 2
            await until(lambda: port.connected)


async def test_sequence_numbers_are_each_component_s_own(tmp_path: Path) -> None:
    cable = PtyWire(tmp_path / "autopilot")
    cable.plug()
    port = port_at(f"serial:{cable.link}:57600", component_id=191, system_id=9)
    async with running(port.run(Heard())):
        await until(lambda: port.connected)
        assert port.identity == (9, 191)
        for i in range(300):
            port.identity = (1, 191 + i % 2)
            port.send(heartbeat())
        got = bytearray()

        def n_got() -> int:
            got.extend(b"".join(cable.receive()))
            return len(got)

        await until(lambda: n_got() >= 300 * 21)
        assert port.n_dropped == 0
        packets = [got[i : i + 21] for i in range(0, len(got), 21)]
        for component in (191, 192):
            numbers = [raw[4] for raw in packets if raw[6] == component]
            assert numbers == list(range(150))
    cable.unplug()


async def test_messages_bear_the_time_at_which_they_came() -> None:
    with FakeAutopilot("px4", f"udpout:{HOST}:{free()}") as autopilot:
        port, heard = port_at(autopilot.url), Heard()
        clock = FlightClock()
        async with running(port.run(heard)):
            await until(lambda: len(heard.messages) > 10)
            now_ns = clock.now_ns()
            assert all(0 < now_ns - t_ns < 5 * 10**9 for t_ns in heard.times_ns)
            assert heard.times_ns == sorted(heard.times_ns)


def free() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def test_messages_that_cannot_be_packed_are_dropped_counted_and_said() -> None:
    port = port_at("udpin::14550")
    port.send(mavlink.MAVLink_attitude_message(-1, 0, 0, 0, 0, 0, 0))
    assert "not sent (1): MAVLink_attitude_message" in port.trouble
    port.send(mavlink.MAVLink_attitude_message(1, "x", 0, 0, 0, 0, 0))
    port.send(object())
    assert port.n_dropped == 3
    assert port.n_sent == 0


async def test_nothing_that_comes_ends_the_port() -> None:
    """Every kind of message with every kind of payload, and noise between them."""
    noise = random.Random(11)
    loop = asyncio.get_running_loop()
    with socket.create_server((HOST, 0)) as server:
        server.setblocking(False)
        port, heard = port_at(f"tcp:{HOST}:{server.getsockname()[1]}"), Heard()
        async with running(port.run(heard)):
            autopilot, _ = await loop.sock_accept(server)
            with autopilot:
                for message_id, kind in mavlink.mavlink_map.items():
                    for payload in (b"", b"\xff" * 255, noise.randbytes(kind.unpacker.size)):
                        data = framed(message_id, payload) + noise.randbytes(message_id % 30)
                        await loop.sock_sendall(autopilot, data)
                await loop.sock_sendall(autopilot, Speaker().attitude(1) * 20)
                await until(lambda: len(heard.of("ATTITUDE")) >= 20)
                assert len(heard.messages) > 2.9 * len(mavlink.mavlink_map)
                assert port.n_bad > 100


def framed(message_id: int, payload: bytes) -> bytes:
    from pymavlink.generator.mavcrc import x25crc

    body = bytes([len(payload), 0, 0, 0, 1, 1]) + message_id.to_bytes(3, "little") + payload
    crc = int(x25crc(body + bytes([mavlink.mavlink_map[message_id].crc_extra])).crc)
    return b"\xfd" + body + crc.to_bytes(2, "little")


async def test_a_thousand_unknown_messages_a_second_disturb_nobody() -> None:
    there = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with there, client:
        for each in (there, client):
            each.bind((HOST, 0))
            each.setblocking(False)
        url = f"udpin:{HOST}:{free()}"
        port = port_at(url, (f"udpout:{HOST}:{client.getsockname()[1]}",))
        heard, autopilot = Heard(), Speaker()
        to = HOST, int(url.rpartition(":")[2])
        async with running(port.run(heard)):
            await until(lambda: port.connected)
            begun_s, used_s, forwarded = time.monotonic(), time.process_time(), 0
            for i in range(1000):
                there.sendto(unknown(i), to)
                if i % 10 == 0:
                    there.sendto(autopilot.attitude(i), to)
                    await asyncio.sleep(max(0, begun_s + i * 1e-3 - time.monotonic()))
                    forwarded += drained(client)
            used_s = time.process_time() - used_s
            await asyncio.sleep(0.02)
            forwarded += drained(client)
        assert len(heard.messages) == 100
        # the first datagram only makes the peer known: an unknown message is nobody's name
        assert port.n_received >= 1098
        assert forwarded >= 1098
        assert used_s < 0.5  # the test's own sending included


def drained(client: socket.socket) -> int:
    n_datagrams = 0
    while True:
        try:
            client.recv(1000)
        except BlockingIOError:
            return n_datagrams
        n_datagrams += 1


# -- signing -------------------------------------------------------------------------------------


@pytest.fixture
def key_file(tmp_path: Path) -> str:
    path = tmp_path / "key"
    path.write_text(KEY.hex() + "\n")
    return str(path)


async def test_signed_both_ways(key_file: str) -> None:
    with FakeAutopilot("px4", f"udpin:{HOST}:0", signing_key=KEY) as autopilot:
        port, heard = port_at(autopilot.url, key_file=key_file), Heard()
        async with running(port.run(heard)):
            await until(lambda: port.connected)
            for i in range(5):
                port.send(attitude(i))
            await until(lambda: len(heard.messages) > 10)
            autopilot.wait_for("ATTITUDE", 5, PATIENCE_S)
            assert autopilot.n_bad == 0
            assert (port.n_unsigned, port.n_bad) == (0, 0)


@pytest.mark.parametrize("autopilots_key", [None, bytes(32)])
async def test_an_autopilot_without_the_key_is_not_listened_to(
    key_file: str, autopilots_key: bytes | None
) -> None:
    with FakeAutopilot("px4", f"udpin:{HOST}:0", signing_key=autopilots_key) as autopilot:
        port, heard = port_at(autopilot.url, key_file=key_file), Heard()
        async with running(port.run(heard)):
            await until(lambda: port.connected)
            port.send(heartbeat())
            if autopilots_key is None:
                await until(lambda: "not signed with the key" in port.trouble)
                assert port.n_bad == port.n_unsigned > 10
            else:
                autopilot_bad = lambda: autopilot.n_bad > 0  # noqa: E731
                await until(autopilot_bad)
            assert heard.messages == []


async def test_an_unsigned_port_has_nothing_to_say_to_an_autopilot_with_a_key() -> None:
    with FakeAutopilot("px4", f"udpin:{HOST}:0", signing_key=KEY) as autopilot:
        port, heard = port_at(autopilot.url), Heard()
        async with running(port.run(heard)):
            await until(lambda: port.connected)
            port.send(heartbeat())
            await until(lambda: autopilot.n_bad > 0)
            assert autopilot.of("HEARTBEAT") == []


def test_a_configuration_that_cannot_be_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"link\.url"):
        port_at("udp:14550")
    with pytest.raises(ConfigError, match=r"link\.signing_key_file"):
        port_at("udpin::14550", key_file=str(tmp_path / "none"))
