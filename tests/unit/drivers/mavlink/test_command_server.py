"""Command protocol of our component: acknowledgements, and execution exactly once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from drivers.mavlink.ground.command_server import (
    ACCEPTED,
    BUSY,
    DENIED,
    FAILED,
    IN_PROGRESS,
    MOST_JOB_NS,
    MOST_REMEMBERED,
    UNSUPPORTED,
    Command,
    CommandServer,
    Done,
    Job,
)
from tests.support.autopilot.ground_station import asked

SECOND = 1_000_000_000
SWITCH, LONG, ASK, NOBODY_KNOWS = 31010, 31012, 512, 400


class Served:
    """A server with a switch, something that takes long, and a question."""

    def __init__(self) -> None:
        self.switched: list[float] = []
        self.jobs: list[Job] = []
        self.n_asked = 0
        self.server = CommandServer({
            SWITCH: Command(self._switch), LONG: Command(self._begin),
            ASK: Command(self._ask, only_asks=True),
        })  # fmt: skip

    def long(
        self, number: int, value: float = 0.0, again: int = 0, t_s: float = 0.0,
        target: tuple[int, int] = (1, 197), asker: tuple[int, int] = (255, 190),
    ) -> list[Any]:  # fmt: skip
        message = mavlink.MAVLink_command_long_message(
            *target, number, again, value, 0, 0, 0, 0, 0, 0
        )
        return self._take(message, t_s, target, asker)

    def int_(self, number: int, value: float = 0.0, t_s: float = 0.0) -> list[Any]:
        message = mavlink.MAVLink_command_int_message(
            1, 197, 0, number, 0, 0, value, 0, 0, 0, 2**31 - 1, 7, 0
        )
        return self._take(message, t_s, (1, 197), (255, 190))

    def _take(
        self, message: Any, t_s: float, target: tuple[int, int], asker: tuple[int, int]
    ) -> list[Any]:
        return self.server.take(asked(message, *asker), target[1] == 0, round(t_s * SECOND))

    def _switch(self, parameters: Sequence[float]) -> Done:
        if parameters[0] not in (0.0, 1.0):
            return Done(DENIED)
        self.switched.append(parameters[0])
        return Done(ACCEPTED)

    def _begin(self, parameters: Sequence[float]) -> Job:
        assert math.isnan(parameters[4]) or parameters[4] == 0.0
        self.jobs.append(Job())
        return self.jobs[-1]

    def _ask(self, parameters: Sequence[float]) -> Done:
        self.n_asked += 1
        return Done(ACCEPTED, [mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)])


@pytest.fixture
def served() -> Served:
    return Served()


def only(answers: list[Any]) -> Any:
    (answer,) = answers
    return answer


def test_answers_go_to_who_asked(served: Served) -> None:
    answer = only(served.long(SWITCH, 1.0, asker=(42, 7)))
    assert (answer.command, answer.result) == (SWITCH, ACCEPTED)
    assert (answer.target_system, answer.target_component) == (42, 7)
    assert served.switched == [1.0]


@pytest.mark.parametrize("value", [0.5, math.nan, math.inf, -1e30])
def test_a_bad_value_is_denied(served: Served, value: float) -> None:
    assert only(served.long(SWITCH, value)).result == DENIED
    assert served.switched == []


def test_what_is_not_known_is_unsupported(served: Served) -> None:
    assert only(served.long(NOBODY_KNOWS)).result == UNSUPPORTED


def test_for_all_only_questions_are_answered(served: Served) -> None:
    """Whose ACK would be taken for the autopilot's."""
    assert served.long(SWITCH, 1.0, target=(1, 0)) == []
    assert served.long(NOBODY_KNOWS, target=(1, 0)) == []
    assert served.switched == []
    answer, message = served.long(ASK, target=(1, 0))
    assert answer.result == ACCEPTED and message.get_type() == "HEARTBEAT"


def test_a_repeat_is_answered_and_not_carried_out(served: Served) -> None:
    served.long(SWITCH, 1.0)
    assert only(served.long(SWITCH, 1.0, again=1, t_s=1)).result == ACCEPTED
    assert only(served.long(SWITCH, 1.0, again=2, t_s=2)).result == ACCEPTED
    assert served.switched == [1.0]
    served.long(SWITCH, 0.0, again=1, t_s=3)  # another value is another command
    served.long(SWITCH, 0.0, t_s=4)
    served.long(SWITCH, 0.0, again=1, t_s=60)  # too long after to be the same
    assert served.switched == [1.0, 0.0, 0.0, 0.0]


def test_the_first_that_arrives_may_be_a_repeat(served: Served) -> None:
    assert only(served.long(SWITCH, 1.0, again=2)).result == ACCEPTED
    assert served.switched == [1.0]


def test_a_repeat_is_of_the_same_asker(served: Served) -> None:
    served.long(SWITCH, 1.0)
    served.long(SWITCH, 1.0, again=1, asker=(254, 190))
    assert served.switched == [1.0, 1.0]


def test_command_int_does_not_count_its_repeats(served: Served) -> None:
    served.int_(SWITCH, 1.0)
    served.int_(SWITCH, 1.0, t_s=3)
    assert served.switched == [1.0]
    served.int_(SWITCH, 1.0, t_s=9)
    assert served.switched == [1.0, 1.0]


def test_questions_are_answered_each_time(served: Served) -> None:
    served.long(ASK)
    assert len(served.long(ASK, again=1)) == 2
    assert served.n_asked == 2


def test_what_takes_long_tells_how_far_it_is(served: Served) -> None:
    began = only(served.long(LONG))
    assert (began.result, began.progress) == (IN_PROGRESS, 0)
    (job,) = served.jobs
    job.percent = 40
    assert served.server.step(SECOND // 10) == []
    told = only(served.server.step(SECOND))
    assert (told.result, told.progress, told.target_system) == (IN_PROGRESS, 40, 255)
    again = only(served.long(LONG, again=1, t_s=1.1))
    assert (again.result, again.progress) == (IN_PROGRESS, 40)
    assert only(served.long(LONG, t_s=1.2)).result == BUSY
    assert only(served.long(LONG, t_s=1.2, asker=(9, 9))).result == BUSY
    assert only(served.int_(LONG, t_s=1.3)).result == BUSY
    job.result = ACCEPTED
    over = only(served.server.step(2 * SECOND))
    assert (over.result, over.target_system) == (ACCEPTED, 255)
    assert served.server.step(3 * SECOND) == []
    assert only(served.long(LONG, again=2, t_s=4)).result == ACCEPTED  # its ACK was lost
    assert len(served.jobs) == 1
    assert only(served.long(LONG, t_s=5)).result == IN_PROGRESS
    assert len(served.jobs) == 2


def test_what_never_ends_has_failed(served: Served) -> None:
    served.long(LONG)
    assert only(served.server.step(MOST_JOB_NS + 1)).result == FAILED
    assert only(served.long(LONG, t_s=200)).result == IN_PROGRESS


def test_askers_without_end_are_forgotten(served: Served) -> None:
    for number in range(4 * MOST_REMEMBERED):
        served.long(SWITCH, 1.0, asker=(number % 250 + 1, number // 250 + 1))
    assert len(served.server._given) == MOST_REMEMBERED
