"""Trust at the router's port: signatures where there is a key, nobody under our identity."""

from __future__ import annotations

import asyncio
import socket
import time
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.timing.clock import FlightClock
from drivers.mavlink.ground.command_server import ACCEPTED, Command, CommandServer, Done
from drivers.mavlink.ground.ground_requests import GroundRequests
from drivers.mavlink.ground.mission_server import MissionServer
from drivers.mavlink.ground.parameter_server import ParameterServer
from tests.support.autopilot.fake_wire import free_port
from tests.support.autopilot.mavlink_link import Speaker, port_at, running
from tests.support.waiting_in_loop import until

NUMBER = 31010
KEY = bytes(range(32))


class Nothing:
    names = ()

    def value(self, name: str) -> float:
        raise KeyError(name)

    def set(self, name: str, value: float) -> int:
        raise KeyError(name)


async def n_done(packets: list[bytes], key_file: str = "") -> int:
    """How often a command was carried out, of those that a client sent to the router."""
    door, done = free_port(socket.SOCK_STREAM), 0
    port = port_at(f"udpin:127.0.0.1:{free_port()}", (f"tcpin:127.0.0.1:{door}",), 256, key_file)

    def carry_out(_parameters: object) -> Done:
        nonlocal done
        done += 1
        return Done(ACCEPTED)

    requests = GroundRequests(
        port, FlightClock(), CommandServer({NUMBER: Command(carry_out)}),
        ParameterServer(Nothing()), MissionServer(lambda: np.empty((0, 3))), lambda _: None,
    )  # fmt: skip
    async with running(port.run(requests.take)):
        await asyncio.sleep(0.05)
        reader, writer = await asyncio.open_connection("127.0.0.1", door)
        for packet in packets:
            writer.write(packet)
        n_all = len(packets)
        await until(lambda: sum(c.n_received for c in port.clients()) == n_all)
        writer.close()
        await writer.wait_closed()
        del reader
    return done


def command(speaker: Speaker, stamp: int | None = None) -> bytes:
    message = mavlink.MAVLink_command_long_message(1, 197, NUMBER, 0, 1, 0, 0, 0, 0, 0, 0)
    return speaker.pack(message, stamp)


def test_with_a_key_only_who_signs_is_obeyed(tmp_path: Path) -> None:
    (tmp_path / "key").write_text(KEY.hex())
    stamp = (time.time_ns() - 1_420_070_400 * 10**9) // 10_000
    good = command(Speaker(255, 190, KEY), stamp)
    packets = [
        command(Speaker(255, 190)),
        command(Speaker(255, 190, bytes(32)), stamp),
        command(Speaker(255, 190, KEY), stamp - 10**9),  # of hours ago
        good,
        good,  # once more
    ]
    assert asyncio.run(n_done(packets, str(tmp_path / "key"))) == 1


def test_without_a_key_nobody_speaks_in_our_name_or_the_autopilots() -> None:
    packets = [command(Speaker(1, 197)), command(Speaker(1, 1)), command(Speaker(255, 190))]
    assert asyncio.run(n_done(packets)) == 1
