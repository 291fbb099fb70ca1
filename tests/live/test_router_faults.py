"""Clients of the router that mean harm, in flight: the pose goes on, and they are named."""

from __future__ import annotations

import contextlib
import random
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.support.autopilot.fake_wire import free_port
from tests.support.processes.flying import Flying

LASTS_S = 2.0
Client = Callable[..., AbstractContextManager[socket.socket]]


@pytest.fixture(scope="module")
def port() -> int:
    return free_port(socket.SOCK_STREAM)


@pytest.fixture(scope="module")
def flying(tmp_path_factory: pytest.TempPathFactory, port: int) -> Iterator[Flying]:
    clients = f'router.clients=["tcpin:127.0.0.1:{port}"]'
    settings = clients, "expert.router.queue_kb=16", "recorder.enabled=false"
    with Flying(tmp_path_factory.mktemp("router"), *settings) as begun:
        begun.until_source("camera", "running")
        begun.until_source("autopilot", "running")
        begun.take_off()
        yield begun


@pytest.fixture
def client(port: int) -> Client:
    @contextlib.contextmanager
    def connect(receives_bytes: int = 1 << 16) -> Iterator[socket.socket]:
        with socket.socket() as connected:
            connected.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receives_bytes)
            connected.connect(("127.0.0.1", port))
            connected.settimeout(0.05)
            yield connected

    return connect


def say(connected: socket.socket, data: bytes) -> None:
    """Send as much as it takes, and listen as it should; who has been cut off says no more."""
    with contextlib.suppress(OSError):
        connected.send(data)
    with contextlib.suppress(OSError):
        connected.setblocking(False)
        connected.recv(1 << 16)


def packed(message: object, system: int, component: int, codec: mavlink.MAVLink) -> bytes:
    codec.srcSystem, codec.srcComponent = system, component
    codec.seq = (codec.seq + 1) % 256
    return bytes(message.pack(codec))  # type: ignore[attr-defined]


def assert_unharmed(flying: Flying, began_ns: int) -> None:
    flying.assert_went_on(began_ns)
    flying.until_source("autopilot", "running")
    assert not [line for line in flying.daemon.said("disarmed") if line.monotonic_ns > began_ns]
    assert not [line for line in flying.daemon.said("rebooted") if line.monotonic_ns > began_ns]
    flying.assert_true_poses()


def test_one_that_pretends_to_be_the_autopilot_or_us(flying: Flying, client: Client) -> None:
    """Upside down, elsewhere, disarmed, at another time; and poses that are not ours."""
    flying.until_sending()
    began_ns, codec = time.monotonic_ns(), mavlink.MAVLink(None)
    lies = (
        mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 3, 3),
        mavlink.MAVLink_attitude_quaternion_message(5, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        mavlink.MAVLink_local_position_ned_message(5, 1e3, 1e3, -1e3, 9.0, 9.0, 9.0),
        mavlink.MAVLink_global_position_int_message(5, 10**8, 10**8, 10**6, 10**6, 0, 0, 0, 0),
        mavlink.MAVLink_timesync_message(7_000_000_000, time.monotonic_ns()),
    )
    pose = mavlink.MAVLink_odometry_message(
        time.time_ns() // 1000, 20, 12, 1e3, 1e3, -1e3, [1.0, 0, 0, 0], 0, 0, 0, 0, 0, 0,
        [0.01] * 21, [0.01] * 21, 0, 3, 100,
    )  # fmt: skip
    with client() as connected:
        while (time.monotonic_ns() - began_ns) * 1e-9 < LASTS_S:
            for lie in lies:
                say(connected, packed(lie, 1, 1, codec))
            say(connected, packed(pose, 1, 197, codec))
            time.sleep(0.02)
        flying.daemon.line("a client of the router is refused", after_ns=began_ns)
    assert_unharmed(flying, began_ns)


def test_one_that_floods(flying: Flying, client: Client) -> None:
    flying.until_sending()
    began_ns, codec = time.monotonic_ns(), mavlink.MAVLink(None)
    asking = mavlink.MAVLink_param_request_read_message(1, 1, b"NO_SUCH_NAME", -1)
    data = b"".join(packed(asking, 255, 190, codec) for _ in range(200))
    n_before = len(flying.autopilot.of("PARAM_REQUEST_READ"))
    with client() as connected:
        while (time.monotonic_ns() - began_ns) * 1e-9 < LASTS_S:
            say(connected, data)
            time.sleep(0.001)
    n_passed = len(flying.autopilot.of("PARAM_REQUEST_READ")) - n_before
    print(f"{n_passed} packets passed on")
    assert 0 < n_passed * len(data) / 200 < 3 * LASTS_S * 50e3
    assert_unharmed(flying, began_ns)


def test_one_that_sends_garbage(flying: Flying, client: Client) -> None:
    flying.until_sending()
    began_ns, rng = time.monotonic_ns(), random.Random(1)
    n_bad = flying.autopilot.n_bad
    with client() as connected:
        while (time.monotonic_ns() - began_ns) * 1e-9 < LASTS_S:
            say(connected, rng.randbytes(2000))
            time.sleep(0.02)
    flying.daemon.line("a client of the router sends damaged data", after_ns=began_ns)
    assert flying.autopilot.n_bad == n_bad
    assert_unharmed(flying, began_ns)


def test_one_that_never_reads(flying: Flying, client: Client) -> None:
    flying.until_sending()
    began_ns = time.monotonic_ns()
    much = mavlink.MAVLink_encapsulated_data_message(0, b"\x55" * 253)
    with client(receives_bytes=2048):
        while not flying.daemon.said("a client of the router is too slow"):
            assert time.monotonic_ns() - began_ns < 60e9
            for _ in range(10):
                flying.autopilot.send(much)
            time.sleep(0.02)
    assert_unharmed(flying, began_ns)


def test_ends_in_time_beside_one_that_never_reads(flying: Flying, client: Client) -> None:
    with client(receives_bytes=2048):
        time.sleep(0.5)
        flying.assert_stops()
    assert not flying.daemon.said("Traceback")
