"""Our component as seen by a pymavlink ground station over UDP."""

from __future__ import annotations

import asyncio
import itertools
import random
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import LinkConfig, RouterConfig
from companion.messages import Warned
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.ground.command_server import CommandServer
from drivers.mavlink.ground.ground_requests import TOO_MANY, GroundRequests
from drivers.mavlink.ground.mission_server import MissionServer
from drivers.mavlink.ground.parameter_server import OUT_OF_RANGE, SET, ParameterServer
from drivers.mavlink.message_requests import MessageRequests
from drivers.mavlink.wire.pymavlink_port import PymavlinkPort
from tests.support.autopilot.fake_wire import free_port
from tests.support.autopilot.ground_station import OURS

REAL32, INT32 = mavlink.MAV_PARAM_TYPE_REAL32, mavlink.MAV_PARAM_TYPE_INT32
ACCEPTED, UNSUPPORTED = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_UNSUPPORTED
REQUEST_MESSAGE = mavlink.MAV_CMD_REQUEST_MESSAGE
WITHIN_S, NOTHING_S = 5.0, 0.3
GROUND = (255, 190)


class Numbers:
    """A table of three; none may be negative."""

    names = ("ONE", "TWO", "SIXTEEN_LETTERS_")

    def __init__(self) -> None:
        self.now = dict.fromkeys(self.names, 1.0)

    def value(self, name: str) -> float:
        return self.now[name]

    def set(self, name: str, value: float) -> int:
        if not value >= 0:
            return OUT_OF_RANGE
        self.now[name] = value
        return SET


class Component:
    """Our end: link, requests and their answers, in a thread."""

    def __init__(self, port: int) -> None:
        self.table, self.warned = Numbers(), list[Warned]()
        self.waypoints = np.array([[47.3977, 8.5456 + 1e-4 * n, 488.0 + n] for n in range(150)])
        self.faults: list[BaseException] = []
        self._url = f"udpin:127.0.0.1:{port}"
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._work)
        self._thread.start()

    def _work(self) -> None:
        self._loop.run_until_complete(self._run())

    async def _run(self) -> None:
        clock, config = FlightClock(), LinkConfig(url=self._url)
        port = PymavlinkPort(config, RouterConfig(clients=()), clock)
        link = AutopilotLink(config, port, clock, lambda _: None, self.warned.append)
        questions = MessageRequests(
            {mavlink.MAVLINK_MSG_ID_HEARTBEAT: link.heartbeat}, lambda: {0: 1.0}, {}, lambda: 0
        )
        requests = GroundRequests(
            port, clock, CommandServer(questions.commands), ParameterServer(self.table),
            MissionServer(lambda: self.waypoints), self.warned.append,
        )  # fmt: skip
        link.on_request = requests.take
        self._tasks = [asyncio.ensure_future(each) for each in (link.run(), requests.run())]
        for came in await asyncio.gather(*self._tasks, return_exceptions=True):
            if isinstance(came, Exception):
                self.faults.append(came)

    def stop(self) -> None:
        self._loop.call_soon_threadsafe(lambda: [task.cancel() for task in self._tasks])
        self._thread.join()
        self._loop.close()


class Peer:
    """A ground station, and the autopilot whose component ours is, on one wire."""

    def __init__(self, port: int) -> None:
        self.wire: Any = mavutil.mavlink_connection(
            f"udpout:127.0.0.1:{port}", source_system=GROUND[0], source_component=GROUND[1],
            dialect="ardupilotmega",
        )  # fmt: skip
        self.mav = self.wire.mav
        self.autopilot = mavlink.MAVLink(None, 1, 1)
        self.heartbeat()

    def heartbeat(self) -> None:
        beat = mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)
        self.wire.write(beat.pack(self.autopilot))

    def next(self, kind: str | list[str], timeout_s: float = WITHIN_S) -> Any:
        """The next of ours of a kind; None where none comes."""
        until_s = time.monotonic() + timeout_s
        while (left_s := until_s - time.monotonic()) > 0:
            message = self.wire.recv_match(type=kind, blocking=True, timeout=left_s)
            if message is not None:
                assert (message.get_srcSystem(), message.get_srcComponent()) == OURS
                return message
        return None

    def request(self, number: int) -> int:
        """Ask for a message; the result."""
        self.mav.command_long_send(*OURS, REQUEST_MESSAGE, 0, number, 0, 0, 0, 0, 0, 0)
        return int(self.next("COMMAND_ACK").result)


@pytest.fixture
def component() -> Iterator[tuple[Component, Peer]]:
    port = free_port(socket.SOCK_DGRAM)
    ours = Component(port)
    peer = Peer(port)
    try:
        deadline_s = time.monotonic() + WITHIN_S
        while peer.next("HEARTBEAT", 0.2) is None:
            assert time.monotonic() < deadline_s
            peer.heartbeat()
        yield ours, peer
    finally:
        ours.stop()
        peer.wire.close()
    assert not ours.faults


def test_its_heartbeat_is_that_of_a_companion_computer(component: tuple[Component, Peer]) -> None:
    beat = component[1].next("HEARTBEAT")
    assert beat.type == mavlink.MAV_TYPE_ONBOARD_CONTROLLER
    assert beat.autopilot == mavlink.MAV_AUTOPILOT_INVALID
    assert beat.base_mode == 0 and beat.mavlink_version == 3


def test_what_qgroundcontrol_asks_of_whoever_has_a_heartbeat(
    component: tuple[Component, Peer],
) -> None:
    """Camera and gimbal are looked for at every component, metadata at some."""
    peer = component[1]
    for number in (259, 280, 395, 397, 411):
        assert peer.request(number) == UNSUPPORTED
    for number in (521, 2504, 300):  # camera information, video streams, mission start
        peer.mav.command_long_send(*OURS, number, 0, 1, 0, 0, 0, 0, 0, 0)
        answer = peer.next("COMMAND_ACK")
        assert (answer.command, answer.result) == (number, UNSUPPORTED)
        assert (answer.target_system, answer.target_component) == GROUND
    assert peer.request(148) == ACCEPTED
    assert peer.next("AUTOPILOT_VERSION").capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2


def test_parameters(component: tuple[Component, Peer]) -> None:
    ours, peer = component
    for target in (OURS[1], 0):  # ground stations ask all at first
        peer.mav.param_request_list_send(1, target)
        listed = [peer.next("PARAM_VALUE") for _ in Numbers.names]
        assert [each.param_id for each in listed] == list(Numbers.names)
        assert [(each.param_index, each.param_count) for each in listed] == [
            (n, 3) for n in range(3)
        ]
        assert {each.param_type for each in listed} == {REAL32}
    peer.mav.param_request_read_send(*OURS, b"", 1)
    assert peer.next("PARAM_VALUE").param_id == "TWO"
    peer.mav.param_request_read_send(*OURS, b"SIXTEEN_LETTERS_", -1)
    assert peer.next("PARAM_VALUE").param_index == 2
    peer.mav.param_set_send(*OURS, b"TWO", 4.5, REAL32)
    assert peer.next("PARAM_VALUE").param_value == 4.5
    for value, kind in ((7.0, INT32), (-1.0, REAL32), (float("nan"), REAL32)):
        peer.mav.param_set_send(*OURS, b"TWO", value, kind)
        assert peer.next("PARAM_VALUE").param_value == 4.5
    assert ours.table.now["TWO"] == 4.5


def test_a_mission_is_fetched_over_a_link_that_loses_a_third(
    component: tuple[Component, Peer],
) -> None:
    """With the times and retries that the protocol asks of a client, and it changes meanwhile."""
    ours, peer = component
    rng, given = random.Random(4), ours.waypoints

    def ask(request: Any, kind: str, wait_s: float, seq: int | None = None) -> Any:
        for _ in range(10):
            if rng.random() > 0.17:
                peer.mav.send(request)
            got = peer.next(kind, wait_s)
            if got is not None and getattr(got, "seq", None) == seq and rng.random() > 0.17:
                return got
        raise AssertionError(f"no {kind}")

    count = ask(mavlink.MAVLink_mission_request_list_message(*OURS), "MISSION_COUNT", 1.5)
    assert (count.target_system, count.target_component) == GROUND
    assert count.count == len(given)
    ours.waypoints = np.zeros((5, 3))
    for n, (latitude, longitude, height) in enumerate(given[:20]):
        request = mavlink.MAVLink_mission_request_int_message(*OURS, n)
        if n % 2:  # of old ground stations
            request = mavlink.MAVLink_mission_request_message(*OURS, n)
        item = ask(request, "MISSION_ITEM_INT", 0.25, n)
        assert (item.x * 1e-7, item.y * 1e-7) == pytest.approx((latitude, longitude), abs=6e-8)
        assert item.z == pytest.approx(height)
        assert (item.frame, item.command) == (mavlink.MAV_FRAME_GLOBAL_INT, 16)
    peer.mav.mission_ack_send(*OURS, mavlink.MAV_MISSION_ACCEPTED)
    while peer.next(["MISSION_ITEM_INT", "MISSION_ACK"], NOTHING_S) is not None:
        pass
    peer.mav.mission_request_list_send(1, 0)  # it is the autopilot's to answer
    assert peer.next("MISSION_COUNT", NOTHING_S) is None


def test_a_long_mission_comes_as_fast_as_it_is_taken(component: tuple[Component, Peer]) -> None:
    ours, peer = component
    peer.mav.mission_request_list_send(*OURS, 0)
    n = peer.next("MISSION_COUNT").count
    for seq in range(n):
        peer.mav.mission_request_int_send(*OURS, seq, 0)
        assert peer.next("MISSION_ITEM_INT").seq == seq
    assert n == 150
    assert TOO_MANY not in [warning.what for warning in ours.warned]


def test_a_ping_is_answered_and_an_answer_is_not(component: tuple[Component, Peer]) -> None:
    peer = component[1]
    peer.mav.ping_send(123_456_789, 41, 0, 0)
    answer = peer.next("PING")
    assert (answer.time_usec, answer.seq) == (123_456_789, 41)
    assert (answer.target_system, answer.target_component) == GROUND
    for target in (OURS, (1, 0), (1, 1), (2, 197)):
        peer.mav.ping_send(1, 42, *target)
    assert peer.next("PING", NOTHING_S) is None


def test_what_is_for_others_is_left_to_them(component: tuple[Component, Peer]) -> None:
    ours, peer = component
    for target in ((1, 1), (1, 191), (2, 197), (2, 0)):
        peer.mav.param_set_send(*target, b"TWO", 9.0, REAL32)
        peer.mav.param_request_list_send(*target)
        peer.mav.param_request_read_send(*target, b"TWO", -1)
        peer.mav.command_long_send(*target, REQUEST_MESSAGE, 0, 148, 0, 0, 0, 0, 0, 0)
    kinds = ["PARAM_VALUE", "PARAM_ERROR", "COMMAND_ACK", "AUTOPILOT_VERSION"]
    assert peer.next(kinds, NOTHING_S) is None
    assert ours.table.now["TWO"] == 1.0


def test_packets_are_numbered_without_a_gap(component: tuple[Component, Peer]) -> None:
    peer = component[1]
    numbers = []
    for n in range(40):
        peer.mav.ping_send(n, n, 0, 0)
        while (message := peer.wire.recv_match(blocking=True, timeout=WITHIN_S)) is not None:
            numbers.append(message.get_seq())
            if message.get_type() == "PING":
                break
    assert len(numbers) >= 40
    assert {(b - a) % 256 for a, b in itertools.pairwise(numbers)} == {1}


def test_nothing_hostile_keeps_it_from_answering(component: tuple[Component, Peer]) -> None:
    """Noise, packets cut or changed anywhere, lengths and kinds that lie; then a fair question."""
    ours, peer = component
    rng, speaker = random.Random(17), mavlink.MAVLink(None, *GROUND)
    seeds = [
        mavlink.MAVLink_param_set_message(*OURS, b"TWO", 3.0, REAL32),
        mavlink.MAVLink_param_request_read_message(*OURS, b"NO\xff\xfe", -7),
        mavlink.MAVLink_param_request_read_message(*OURS, b"", 32767),
        mavlink.MAVLink_command_int_message(*OURS, 3, 512, 9, 9, *[float("inf")] * 4, -1, 1, 0.0),
        mavlink.MAVLink_command_long_message(*OURS, 512, 255, *[float("nan")] * 7),
        mavlink.MAVLink_ping_message(2**64 - 1, 2**32 - 1, 0, 0),
        mavlink.MAVLink_timesync_message(-(2**63), 2**63 - 1),
        mavlink.MAVLink_mission_request_list_message(*OURS, 255),
        mavlink.MAVLink_mission_request_int_message(*OURS, 65535),
        mavlink.MAVLink_mission_count_message(*OURS, 65535),
    ]
    for n in range(600):
        packet = bytearray(rng.choice(seeds).pack(speaker, force_mavlink1=rng.random() < 0.3))
        how = n % 4
        if how == 0:
            packet = bytearray(rng.randbytes(rng.randrange(1, 300)))
        elif how == 1:
            del packet[rng.randrange(len(packet)) :]
        elif how == 2:
            packet[rng.randrange(len(packet))] ^= 1 << rng.randrange(8)
        peer.wire.write(bytes(packet) or b"\xfd")
        if n % 100 == 0:
            time.sleep(0.05)
    until_s = time.monotonic() + 15  # what was asked too often is listened to again after a while
    while time.monotonic() < until_s:
        peer.mav.param_set_send(*OURS, b"ONE", 6.0, REAL32)
        value = peer.next("PARAM_VALUE", 0.5)
        if value is not None and value.param_id == "ONE" and value.param_value == 6.0:
            break
    assert ours.table.now["ONE"] == 6.0
    assert peer.request(148) == ACCEPTED
