"""Requests over the link: who may send them, rate limits, and malformed ones."""

from __future__ import annotations

import asyncio
import random
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import LinkConfig
from companion.messages import Warned
from companion.pilot_messages import PilotText
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.component_messages import (
    autopilot_version,
    component_information,
    message_interval,
    protocol_version,
)
from drivers.mavlink.ground.command_server import ACCEPTED, Command, CommandServer, Done
from drivers.mavlink.ground.ground_requests import KINDS, TOO_MANY, GroundRequests
from drivers.mavlink.ground.mission_server import MissionServer
from drivers.mavlink.ground.parameter_server import SET, ParameterServer
from drivers.mavlink.ground.request_limit import EACH_BURST, MOST_ASKERS, request_limit
from drivers.mavlink.status_text import TEXTS_AT_ONCE, WARNINGS_ONLY, TextLimit
from drivers.mavlink.wire.packet_stream import MavlinkStream, decode
from tests.support.autopilot.ground_station import asked
from tests.support.autopilot.mavlink_link import Speaker
from tests.support.autopilot.memory_port import MemoryPort
from tests.support.waiting_in_loop import until

SECOND = 1_000_000_000
NUMBER = 31010
INFO, WARNING = mavlink.MAV_SEVERITY_INFO, mavlink.MAV_SEVERITY_WARNING


class One:
    """A table of one parameter."""

    names = ("ONE",)
    now = 1.0

    def value(self, name: str) -> float:
        return self.now

    def set(self, name: str, value: float) -> int:
        self.now = value
        return SET


class Asked:
    """Our component on a port without a wire."""

    def __init__(self) -> None:
        self.port, self.warned = MemoryPort(), list[Warned]()
        self.port.identity = (1, 197)
        self.table, self.n_done = One(), 0
        self.requests = GroundRequests(
            self.port, FlightClock(), CommandServer({NUMBER: Command(self._do)}),
            ParameterServer(self.table), MissionServer(lambda: np.zeros((3, 3))),
            self.warned.append,
        )  # fmt: skip

    def _do(self, _parameters: object) -> Done:
        self.n_done += 1
        return Done(ACCEPTED)

    def command(self, target: tuple[int, int], t_ns: int, asker: int = 255) -> None:
        message = mavlink.MAVLink_command_long_message(*target, NUMBER, 0, 1, 0, 0, 0, 0, 0, 0)
        self.requests.take(asked(message, asker), t_ns)


def test_only_what_is_meant_for_us() -> None:
    ours = Asked()
    for target in ((2, 197), (1, 1), (1, 196), (1, 0), (0, 0), (0, 197)):
        ours.command(target, SECOND)
    assert (ours.n_done, ours.port.sent) == (0, [])
    ours.command((1, 197), SECOND)
    assert ours.n_done == 1
    assert [each.get_type() for each in ours.port.sent] == ["COMMAND_ACK"]


def test_a_storm_is_cut_off_and_named_once() -> None:
    ours = Asked()
    for n in range(2000):
        ours.command((1, 197), SECOND + n * 1000)
    assert EACH_BURST <= ours.n_done <= EACH_BURST + 2
    assert [each.what for each in ours.warned] == [TOO_MANY]
    ours.command((1, 197), SECOND, asker=254)  # another is listened to all the same
    assert ours.n_done <= EACH_BURST + 3
    n_before = ours.n_done
    ours.command((1, 197), 3 * SECOND)
    assert ours.n_done == n_before + 1


def test_askers_that_change_their_names_share_what_there_is_for_all() -> None:
    limit = request_limit()
    n = sum(limit.allows((n % 250, n // 250), SECOND + n) for n in range(5000))
    assert n <= 301
    assert limit.n_refused == 5000 - n
    assert len(limit._peers) <= MOST_ASKERS


def test_nothing_that_is_sent_breaks_it() -> None:
    """Every kind with every byte at random, and the same damaged behind a good checksum."""
    rng, ours, codec = random.Random(5), Asked(), mavlink.MAVLink(None)
    stream, n_taken = MavlinkStream(), 0
    for n in range(4000):
        kind = mavlink.mavlink_map[rng.choice(sorted(KINDS))]
        payload = bytearray(rng.randbytes(kind.unpacker.size))
        if rng.random() < 0.9:  # mostly for us
            message = kind.__new__(kind)
            mavlink.MAVLink_message.__init__(message, kind.id, kind.msgname)
            at = {name: place for place, name in enumerate(kind.ordered_fieldnames)}
            fields = list(kind.unpacker.unpack(payload))
            fields[at["target_system"]], fields[at["target_component"]] = 1, rng.choice((0, 197))
            if "command" in at and rng.random() < 0.5:
                fields[at["command"]] = NUMBER
            payload = bytearray(kind.unpacker.pack(*fields))
        message = kind.__new__(kind)
        mavlink.MAVLink_message.__init__(message, kind.id, kind.msgname)
        speaker = mavlink.MAVLink(None, rng.randrange(256), rng.randrange(256))
        raw = bytes(message._pack(speaker, kind.crc_extra, bytes(payload)))
        for packet in stream.feed(raw, n):
            whole = decode(codec, packet)
            if whole is not None:
                n_taken += 1
                ours.requests.take(whole, n * SECOND)
        ours.requests._parameters.next_message()
    assert n_taken > 3500
    assert ours.n_done > 10
    assert len(ours.port.sent) > ours.n_done  # others were told that theirs is not known


async def test_the_link_hands_on_what_others_than_the_autopilot_ask() -> None:
    port, clock = MemoryPort(), FlightClock()
    link = AutopilotLink(LinkConfig(), port, clock, lambda _: None, lambda _: None)
    table = One()
    requests = GroundRequests(
        port, clock, CommandServer({}), ParameterServer(table),
        MissionServer(lambda: np.zeros((3, 3))), lambda _: None,
    )  # fmt: skip
    link.on_request = requests.take
    tasks = [asyncio.ensure_future(each) for each in (link.run(), requests.run())]
    await asyncio.sleep(0.05)
    port.hear(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3), clock.now_ns())
    message = mavlink.MAVLink_param_set_message(1, 197, b"ONE", 2.0, 9)
    port.hear(message, clock.now_ns(), 255, 190)
    await until(lambda: bool(port.of("PARAM_VALUE")))
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    assert table.now == 2.0
    assert [each.param_value for each in port.of("PARAM_VALUE")] == [2.0]


def test_messages_that_the_dialect_lacks_are_whole_packets() -> None:
    extra = {300: 217, 396: 50}
    for message, number in ((protocol_version(), 300), (component_information(5), 396)):
        raw = Speaker(1, 197).pack(message)
        assert raw[0] == 0xFD and int.from_bytes(raw[7:10], "little") == number
        crc = mavlink.x25crc(bytearray(raw[1:-2]))
        crc.accumulate(bytes([extra[number]]))
        assert crc.crc == int.from_bytes(raw[-2:], "little")
    assert raw[10 + 16 :].startswith(b"companion\0")


def test_versions_and_intervals() -> None:
    version: Any = asked(autopilot_version(), 1, 197)
    assert version.capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    assert version.flight_sw_version >> 16 == 1  # 0.1
    assert message_interval(30, None).interval_us == 0
    assert message_interval(390, 1.0).interval_us == 1_000_000
    assert message_interval(390, 0.0).interval_us == -1


def test_texts_come_slowly_and_say_what_was_left_out() -> None:
    limit = TextLimit()
    info = [PilotText(INFO, f"text {n}") for n in range(20)]
    warnings = [PilotText(WARNING, f"warning {n}") for n in range(20)]
    said = [limit.passed(each, SECOND) for each in info]
    assert sum(map(bool, said)) == TEXTS_AT_ONCE - WARNINGS_ONLY
    warned = [limit.passed(each, SECOND) for each in warnings]
    assert sum(map(bool, warned)) == WARNINGS_ONLY
    # what is left out is not told at the cost of the next warning
    assert limit.passed(warnings[19], 3 * SECOND) == [warnings[19]]
    last = limit.passed(warnings[18], 60 * SECOND)
    assert [each.text for each in last] == [
        "warning 18", "Companion: 26 messages left out, see its log",
    ]  # fmt: skip
    assert limit.passed(info[0], 61 * SECOND) == [info[0]]
