"""Command protocol, client side: retransmitted until acknowledged, one of a kind at a time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.geometry.geodesy import GeoOrigin
from drivers.system.within import within

NO_ANSWER = -1
"""Result of a command that was never acknowledged."""
REFUSALS = (
    mavlink.MAV_RESULT_DENIED, mavlink.MAV_RESULT_UNSUPPORTED, mavlink.MAV_RESULT_FAILED,
)  # fmt: skip
TRIES = 3
ANSWER_S = 1.0
MOST_PATIENCE_S = 30.0
"""Longest wait after an acknowledgement "in progress"."""

AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1

MakeCommand = Callable[[int], Any]
"""Makes the message of a try, counted from 0."""


def command_long(system: int, command: int, attempt: int, *params: float) -> Any:
    """COMMAND_LONG to the autopilot of a system; `attempt` counts repetitions, from 0."""
    values = [*params, *[0.0] * (7 - len(params))]
    return mavlink.MAVLink_command_long_message(system, AUTOPILOT, command, attempt, *values)


def command_at(system: int, command: int, place: GeoOrigin) -> Any:
    """COMMAND_INT to the autopilot of a system, for a place; altitude above mean sea level."""
    return mavlink.MAVLink_command_int_message(
        system, AUTOPILOT, mavlink.MAV_FRAME_GLOBAL, command, 0, 0,
        0.0, 0.0, 0.0, 0.0,
        round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7), place.altitude_m,
    )  # fmt: skip


def source_set_command(system: int, number: int) -> Any:
    """The command to fly on a source set of ArduPilot's EKF3, the first time that it is sent."""
    return command_long(system, mavlink.MAV_CMD_SET_EKF_SOURCE_SET, 0, float(number))


class Commands:
    """Commands to the autopilot of a system, which `target` tells; of a kind one at a time."""

    def __init__(self, send: Callable[[Any], None], target: Callable[[], int]) -> None:
        self._send, self._target = send, target
        self._turns: dict[int, asyncio.Lock] = {}
        self._answers: dict[int, asyncio.Queue[int]] = {}

    async def long(
        self, command: int, *params: float, timeout_s: float = ANSWER_S, tries: int = TRIES
    ) -> int:
        """Send a COMMAND_LONG until acknowledged: a MAV_RESULT, or NO_ANSWER."""
        system = self._target()

        def make(attempt: int) -> Any:
            return command_long(system, command, attempt, *params)

        return await self._ask(command, make, timeout_s, tries)

    async def at(self, command: int, place: GeoOrigin) -> int:
        """Send a COMMAND_INT for a geodetic position, altitude above mean sea level; likewise."""
        message = command_at(self._target(), command, place)
        return await self._ask(command, lambda _attempt: message, ANSWER_S, TRIES)

    async def set_source_set(self, number: int) -> int:
        """Fly on a source set of ArduPilot's EKF3 (EK3_SRC1_… is 1): likewise."""
        return await self.long(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, float(number))

    async def _ask(self, command: int, make: MakeCommand, timeout_s: float, tries: int) -> int:
        async with self._turns.setdefault(command, asyncio.Lock()):
            answers: asyncio.Queue[int] = asyncio.Queue(maxsize=8)
            self._answers[command] = answers
            try:
                return await self._until_answered(make, answers, timeout_s, tries)
            finally:
                del self._answers[command]

    def answered(self, acknowledgement: Any, identity: tuple[int, int]) -> None:
        """Take a COMMAND_ACK of the autopilot."""
        targets = acknowledgement.target_system, acknowledgement.target_component
        for target, ours in zip(targets, identity, strict=True):
            if target not in (0, ours):
                return
        answers = self._answers.get(acknowledgement.command)
        if answers is not None and not answers.full():
            answers.put_nowait(acknowledgement.result)

    async def _until_answered(
        self, make: MakeCommand, answers: asyncio.Queue[int], timeout_s: float, tries: int
    ) -> int:
        for attempt in range(tries):
            self._send(make(attempt))
            wait_s = timeout_s
            while True:
                try:
                    result = await within(answers.get(), wait_s)
                except asyncio.TimeoutError:
                    break
                if result != mavlink.MAV_RESULT_IN_PROGRESS:
                    return result
                wait_s = MOST_PATIENCE_S
        return NO_ANSWER
