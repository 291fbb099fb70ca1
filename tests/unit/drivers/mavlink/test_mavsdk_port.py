from __future__ import annotations

import asyncio
import math
import socket
import struct
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import LinkConfig, RouterConfig
from companion.errors import ConfigError
from companion.timing.clock import FlightClock
from drivers.mavlink.wire.link_port import link_port
from drivers.mavlink.wire.mavsdk_carrier import ITSELF
from drivers.mavlink.wire.pymavlink_port import PymavlinkPort
from drivers.telemetry.mavlink_samples import samples_of
from tests.support.autopilot.fake_autopilot import FakeAutopilot
from tests.support.autopilot.fake_flight import circle
from tests.support.autopilot.fake_wire import free_port
from tests.support.flights.sample_faults import read_tlog
from tests.support.processes.strain import within
from tests.support.waiting_in_loop import until

CLOCK = FlightClock()
SAMPLE = Path(__file__).parents[4] / "sample" / "survey"
Heard = list[tuple[Any, int]]


@asynccontextmanager
async def running(port: PymavlinkPort) -> AsyncIterator[Heard]:
    heard: Heard = []
    task = asyncio.ensure_future(port.run(lambda message, t_ns: heard.append((message, t_ns))))
    try:
        yield heard
    finally:
        task.cancel()
        with within(1.0):
            await asyncio.gather(task, return_exceptions=True)


def port_of(url: str, clients: tuple[str, ...] = (), **link: Any) -> PymavlinkPort:
    config = LinkConfig(url=url, **{"backend": "mavsdk", **link})
    port = link_port(config, RouterConfig(clients), CLOCK)
    assert isinstance(port, PymavlinkPort)
    return port


def kinds(heard: Heard) -> list[str]:
    return [message.get_type() for message, _ in heard]


class Peer:
    """A plain MAVLink peer on UDP."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setblocking(False)
        self.codec = mavlink.MAVLink(None, 1, 1)
        self.codec.robust_parsing = True
        self.got: list[Any] = []
        self.of_mavsdk: list[Any] = []
        """What MAVSDK says of its own."""

    @property
    def url(self) -> str:
        return f"udpout:127.0.0.1:{self.socket.getsockname()[1]}"

    def listen(self) -> int:
        """How many messages have come so far."""
        while True:
            try:
                data, self.other = self.socket.recvfrom(2048)
            except BlockingIOError:
                return len(self.got)
            for message in self.codec.parse_buffer(bytearray(data)) or []:
                source = message.get_srcSystem(), message.get_srcComponent()
                (self.of_mavsdk if source == ITSELF else self.got).append(message)

    def send(self, message: Any) -> bytes:
        packet = bytes(message.pack(self.codec))
        self.codec.seq = (self.codec.seq + 1) % 256
        self.socket.sendto(packet, self.other)
        return packet

    def close(self) -> None:
        self.socket.close()


@asynccontextmanager
async def linked(**link: Any) -> AsyncIterator[tuple[Peer, PymavlinkPort, Heard]]:
    peer = Peer()
    port = port_of(peer.url, **link)
    try:
        async with running(port) as heard:
            await until(lambda: port.connected)
            port.send(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
            await until(peer.listen)
            yield peer, port, heard
    finally:
        peer.close()


async def test_mavsdk_is_another_component_and_what_it_says_does_not_come_back() -> None:
    async with linked() as (peer, port, heard):
        for _ in range(14):  # a heartbeat a second, and a question for the version
            peer.send(mavlink.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3))
            await asyncio.sleep(0.1)
        port.send(mavlink.MAVLink_timesync_message(0, 5))
        await until(lambda: peer.listen() > 1)
        assert [m.get_type() for m in peer.got] == ["HEARTBEAT", "TIMESYNC"]
        assert {(m.get_srcSystem(), m.get_srcComponent()) for m in peer.got} == {(1, 197)}
        assert [m.get_seq() for m in peer.got] == [0, 1]
        assert "HEARTBEAT" in {m.get_type() for m in peer.of_mavsdk}
        assert [m.get_srcSystem() for m, _ in heard] == [1] * 14


async def test_every_bit_of_a_message_comes_and_goes() -> None:
    minus_one = struct.unpack("<f", struct.pack("<i", -1))[0]  # an integer of PX4, and a NaN
    async with linked() as (peer, port, heard):
        peer.send(mavlink.MAVLink_param_value_message(b"SYS_X", minus_one, 6, 900, 3))
        peer.send(mavlink.MAVLink_statustext_message(4, b'\xff\xfe "quoted"'))
        peer.send(mavlink.MAVLink_command_ack_message(512, 0, 0, 0, 1, 197))
        peer.codec.srcSystem, peer.codec.srcComponent = 42, 1  # never said that it is there
        peer.send(mavlink.MAVLink_attitude_quaternion_message(7, 1, 0, 0, 0, 0, math.nan, 0))
        await until(lambda: len(heard) == 4)
        value, text, answer, other = (message for message, _ in heard)
        assert struct.pack("<f", value.param_value) == b"\xff" * 4
        assert text.text.endswith('"quoted"')
        assert (answer.get_type(), answer.target_component) == ("COMMAND_ACK", 197)
        assert other.get_srcSystem() == 42
        assert math.isnan(other.pitchspeed)

        covariance = [math.nan] + [0.0] * 20
        port.send(
            mavlink.MAVLink_odometry_message(
                2**63 + 1, 20, 12, 1.5, 0.1, -2, [1, 0, 0, 0], 1, 2, 3, 0, 0, 0,
                covariance, covariance, 255, 3, -1,
            )
        )  # fmt: skip
        await until(lambda: peer.listen() == 2)
        sent = peer.got[1]
        assert (sent.time_usec, sent.reset_counter, sent.quality) == (2**63 + 1, 255, -1)
        assert math.isnan(sent.pose_covariance[0])
        assert port.n_sent == 2
        assert port.n_dropped == 0


@pytest.mark.real_time
async def test_stamp_is_that_of_arrival() -> None:
    async with linked() as (peer, _, heard):
        before_ns = CLOCK.now_ns()
        peer.send(mavlink.MAVLink_timesync_message(0, 1))
        time.sleep(0.2)  # the event loop is held up; MAVSDK's thread is not
        await until(lambda: heard)
        assert before_ns < heard[0][1] < before_ns + 100_000_000


@pytest.mark.real_time
async def test_rates_of_100_and_200_hz() -> None:
    with FakeAutopilot("ardupilot", "udpin:127.0.0.1:0", circle()) as autopilot:
        autopilot.rates_hz.update(ATTITUDE_QUATERNION=100, RAW_IMU=200)
        port = port_of(autopilot.url)
        async with running(port) as heard:
            await until(lambda: port.connected)
            port.send(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
            await until(lambda: heard)
            begin, begun_s = len(heard), time.monotonic()
            await asyncio.sleep(1.0)
            passed_s = time.monotonic() - begun_s
            new = kinds(heard)[begin:]
            sent = autopilot.rates_hz
        # a busy machine keeps the pretended autopilot from its rates; nothing may be lost
        assert new.count("ATTITUDE_QUATERNION") >= 0.5 * passed_s * sent["ATTITUDE_QUATERNION"]
        assert new.count("RAW_IMU") >= 0.5 * passed_s * sent["RAW_IMU"]
        sample = next(m for m, _ in heard if m.get_type() == "RAW_IMU")
        assert samples_of(sample, less_biases=False)
        assert port.n_bad == 0


async def test_both_backends_give_the_same_of_a_recorded_flight() -> None:
    packets = [each.packet for each in islice(read_tlog(SAMPLE / "telemetry.tlog"), 600)]

    async def heard_by(backend: Literal["pymavlink", "mavsdk"]) -> list[str]:
        place = free_port()
        port = port_of(f"udpin:127.0.0.1:{place}", backend=backend)
        async with running(port) as heard:
            await until(lambda: port.connected)
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
                for number, packet in enumerate(packets):
                    out.sendto(packet, ("127.0.0.1", place))
                    if number % 50 == 49:
                        await until(lambda sent=number + 1: len(heard) == sent)  # type: ignore[misc]
            return [f"{m.get_header().seq} {m.get_srcSystem()} {m}" for m, _ in heard]

    assert await heard_by("mavsdk") == await heard_by("pymavlink")


async def test_rubbish_is_passed_over() -> None:
    async with linked() as (peer, _, heard):
        whole = bytearray(mavlink.MAVLink_timesync_message(0, 1).pack(peer.codec))
        wrong = bytes(whole[:-1]) + bytes([whole[-1] ^ 1])
        for rubbish in (bytes(range(256)) * 5, wrong, bytes(whole[:9]), b"\xfd\xff" * 100):
            peer.socket.sendto(rubbish, peer.other)
        for number in range(20):
            peer.send(mavlink.MAVLink_timesync_message(0, number))
        # what was cut short may swallow what comes next, no more
        await until(lambda: heard and heard[-1][0].ts1 == 19)
        assert set(kinds(heard)) == {"TIMESYNC"}
        assert len(heard) >= 18


async def test_tcp_comes_back() -> None:
    autopilot = FakeAutopilot("px4", "tcpin:127.0.0.1:0")
    port = port_of(autopilot.url)
    async with running(port) as heard:
        await until(lambda: "refused" in port.trouble)
        with autopilot:
            await until(lambda: heard)
            assert port.trouble == ""
            autopilot.unplug()
            await asyncio.sleep(0.2)
            heard.clear()
            autopilot.plug()
            await until(lambda: heard)
            port.send(mavlink.MAVLink_timesync_message(0, 5))
            await asyncio.to_thread(autopilot.wait_for, "TIMESYNC")


async def test_serial_line_is_found_and_comes_back(tmp_path: Path) -> None:
    device = tmp_path / "tty"
    port = port_of(f"serial:{device}:115200")
    async with running(port) as heard:
        await until(lambda: str(device) in port.trouble)
        assert not port.connected
        with FakeAutopilot("px4", f"pty:{device}") as autopilot:
            await until(lambda: heard)
            autopilot.unplug()
            await until(lambda: not port.connected)
            heard.clear()
            autopilot.plug()
            await until(lambda: heard)
            port.send(mavlink.MAVLink_timesync_message(0, 5))
            await asyncio.to_thread(autopilot.wait_for, "TIMESYNC")


async def test_baud_is_found_out(tmp_path: Path) -> None:
    with FakeAutopilot("px4", f"pty:{tmp_path / 'tty'}:57600") as autopilot:
        port = port_of(autopilot.url.rsplit(":", 1)[0] + ":auto")
        async with running(port) as heard:
            await until(lambda: "HEARTBEAT" in kinds(heard))


async def test_end_does_not_wait_for_a_line_that_takes_nothing(tmp_path: Path) -> None:
    with FakeAutopilot("px4", f"pty:{tmp_path / 'tty'}") as autopilot:
        port = port_of(f"serial:{tmp_path / 'tty'}:115200")
        async with running(port) as heard:
            await until(lambda: heard)
            autopilot._wire.receive = list  # type: ignore[method-assign] # reads no more
            for number in range(5000):
                port.send(mavlink.MAVLink_timesync_message(0, number))
            await until(lambda: port.n_dropped > 1000)


async def test_signed(tmp_path: Path) -> None:
    key = bytes(range(32))
    (tmp_path / "key").write_text(key.hex())
    (tmp_path / "key").chmod(0o600)
    with FakeAutopilot("ardupilot", "udpin:127.0.0.1:0", signing_key=key) as autopilot:
        port = port_of(autopilot.url, signing_key_file=str(tmp_path / "key"))
        async with running(port) as heard:
            await until(lambda: port.connected)
            port.send(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
            await until(lambda: heard)
            await asyncio.to_thread(autopilot.wait_for, "HEARTBEAT")
            assert port.n_unsigned == 0


async def test_clients_share_the_link() -> None:
    client = Peer()
    try:
        with FakeAutopilot("px4", "udpin:127.0.0.1:0") as autopilot:
            port = port_of(autopilot.url, clients=(client.url,))
            async with running(port):
                await until(lambda: port.connected)
                port.send(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
                await until(
                    lambda: client.listen() and any(g.get_srcComponent() == 1 for g in client.got)
                )
                client.codec.srcSystem, client.codec.srcComponent = 255, 190
                client.send(mavlink.MAVLink_param_request_read_message(1, 1, b"EKF2_EN", -1))
                await until(
                    lambda: (
                        client.listen() and any(g.get_type() == "PARAM_VALUE" for g in client.got)
                    )
                )
    finally:
        client.close()


def test_no_ipv6() -> None:
    with pytest.raises(ConfigError, match="MAVSDK has no IPv6"):
        port_of("udpout:[::1]:14550")
