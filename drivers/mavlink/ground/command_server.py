"""Command protocol, server side: each command acknowledged, executed once, progress reported.

Messages in, messages out: no clock, no wire. The protocol:
https://mavlink.io/en/services/command.html.
"""

from __future__ import annotations

import math
import struct
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

ACCEPTED: int = mavlink.MAV_RESULT_ACCEPTED
BUSY: int = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
DENIED: int = mavlink.MAV_RESULT_DENIED
FAILED: int = mavlink.MAV_RESULT_FAILED
UNSUPPORTED: int = mavlink.MAV_RESULT_UNSUPPORTED
IN_PROGRESS: int = mavlink.MAV_RESULT_IN_PROGRESS
REPEAT_NS = 30_000_000_000
"""Time within which a command whose `confirmation` counts up is a retransmission."""
SAME_INT_NS = 5_000_000_000
"""COMMAND_INT does not count its repeats: an equal one within this time is a retransmission."""
PROGRESS_NS = 500_000_000
MOST_JOB_NS = 120_000_000_000
MOST_REMEMBERED = 64
NOT_GIVEN_INT = 2**31 - 1
Asker = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Done:
    """Result of an immediate command: its MAV_RESULT, and messages that it requested."""

    result: int
    messages: Sequence[Any] = ()


@dataclass(slots=True)
class Job:
    """A command that takes longer, with its progress."""

    percent: int = 0
    result: int | None = None
    """A MAV_RESULT when it is finished."""


Handler = Callable[[Sequence[float]], Done | Job]
"""Executes a command with its seven parameters; those not given are NaN or 0."""


@dataclass(frozen=True, slots=True)
class Command:
    """Handler of a command; one that `only_asks` may be broadcast, and is never a repeat."""

    handler: Handler
    only_asks: bool = False


@dataclass(slots=True)
class _Given:
    """Last answer to one command of one sender."""

    parameters: bytes
    t_ns: int
    result: int
    job: Job | None = None


@dataclass(slots=True)
class _Running:
    asker: Asker
    given: _Given
    job: Job
    began_ns: int
    reported_ns: int


class CommandServer:
    """COMMAND_LONG and COMMAND_INT in, COMMAND_ACK out."""

    def __init__(self, commands: Mapping[int, Command]) -> None:
        self._commands = commands
        self._given: OrderedDict[tuple[Asker, int], _Given] = OrderedDict()
        self._running: dict[int, _Running] = {}

    def take(self, message: Any, to_all: bool, now_ns: int) -> list[Any]:
        """Execute a command, and acknowledge it; broadcasts are answered only for requests."""
        asker = message.get_srcSystem(), message.get_srcComponent()
        number, parameters = message.command, _parameters(message)
        command = self._commands.get(number)
        if to_all and (command is None or not command.only_asks):
            return []
        if command is None:
            return [_answer(asker, number, UNSUPPORTED)]
        packed = struct.pack("<7d", *parameters)
        last = self._given.get((asker, number))
        if last is not None and not command.only_asks and _is_repeat(message, packed, last, now_ns):
            last.t_ns = now_ns
            percent = last.job.percent if last.job is not None else 0
            return [_answer(asker, number, last.result, percent)]
        if number in self._running:
            return [_answer(asker, number, BUSY)]
        outcome = command.handler(parameters)
        if isinstance(outcome, Job):
            given = _Given(packed, now_ns, IN_PROGRESS, outcome)
            self._running[number] = _Running(asker, given, outcome, now_ns, now_ns)
            answers = [_answer(asker, number, IN_PROGRESS, outcome.percent)]
        else:
            if to_all and outcome.result != ACCEPTED:
                return []
            given = _Given(packed, now_ns, outcome.result)
            answers = [_answer(asker, number, outcome.result), *outcome.messages]
        self._remember(asker, number, given)
        return answers

    def step(self, now_ns: int) -> list[Any]:
        """Acknowledgements due for commands that still run, or are finished."""
        out = []
        for number, running in list(self._running.items()):
            job = running.job
            if job.result is None and now_ns - running.began_ns > MOST_JOB_NS:
                job.result = FAILED
            if job.result is not None:
                del self._running[number]
                running.given.result, running.given.t_ns = job.result, now_ns
                out.append(_answer(running.asker, number, job.result))
            elif now_ns - running.reported_ns >= PROGRESS_NS:
                running.reported_ns = now_ns
                out.append(_answer(running.asker, number, IN_PROGRESS, job.percent))
        return out

    def _remember(self, asker: Asker, number: int, given: _Given) -> None:
        self._given.pop((asker, number), None)
        self._given[asker, number] = given
        while len(self._given) > MOST_REMEMBERED:
            self._given.popitem(last=False)


def _is_repeat(message: Any, packed: bytes, last: _Given, now_ns: int) -> bool:
    if packed != last.parameters:
        return False
    since_ns = now_ns - last.t_ns
    if message.get_msgId() == mavlink.MAVLINK_MSG_ID_COMMAND_LONG:
        still = last.result == IN_PROGRESS or since_ns < REPEAT_NS
        return bool(message.confirmation > 0 and still)
    return last.result == IN_PROGRESS or since_ns < SAME_INT_NS


def _parameters(message: Any) -> tuple[float, ...]:
    """All seven; NaN where COMMAND_INT marks one as not given."""
    first = message.param1, message.param2, message.param3, message.param4
    if message.get_msgId() == mavlink.MAVLINK_MSG_ID_COMMAND_LONG:
        return (*first, message.param5, message.param6, message.param7)
    place = (math.nan if v == NOT_GIVEN_INT else float(v) for v in (message.x, message.y))
    return (*first, *place, message.z)


def _answer(asker: Asker, number: int, result: int, percent: int = 0) -> Any:
    progress = min(max(percent, 0), 100) if result == IN_PROGRESS else 0
    return mavlink.MAVLink_command_ack_message(number, result, progress, 0, *asker)
