from __future__ import annotations

import threading

import numpy as np
import pytest

from companion.config import Config
from companion.geometry.transforms import Pose
from companion.messages import DepthMap, Frame, MapUpdate
from companion.runtime.mailbox import DropPolicy, Mailbox
from companion.runtime.message_size import ENTRY_BYTES, SMALL_BYTES, size_bytes
from companion.runtime.parcel import Parcel
from companion.runtime.stage_protocol import Finish, Setup
from companion.runtime.stages import DROPPED
from companion.telemetry import AttitudeSample
from tests.support.flights.topic_flight import CAMERA

Sent = tuple[DropPolicy, int, str]


def mailbox(room: int = 100) -> Mailbox[Sent]:
    return Mailbox(lambda sent: sent[0], lambda sent: sent[1], room)


def test_where_nothing_may_be_lost_whoever_puts_waits_for_room() -> None:
    box: Mailbox[Sent] = Mailbox(lambda sent: sent[0], lambda sent: sent[1], 100, waits=True)
    box.put((DropPolicy.PICTURE, 1000, "larger than all room"))
    names = [f"picture {number}" for number in range(50)]

    def put() -> None:
        for name in names:
            box.put((DropPolicy.PICTURE, 40, name))

    putter = threading.Thread(target=put)
    putter.start()
    taken: list[str] = []
    while len(taken) < 50:
        message = box.get()
        assert message is not None and box.n_bytes <= 100
        taken.append(message[2])
    putter.join(30)
    assert [*taken, *names_in(box)] == ["larger than all room", *names]
    box.put((DropPolicy.PICTURE, 200, "too late"))
    assert box.n_overflowed == 1, "and whoever waits for one that is closed does not for ever"


def names_in(box: Mailbox[Sent]) -> list[str]:
    box.close()
    out = []
    while (sent := box.get()) is not None:
        out.append(sent[2])
    return out


def test_messages_come_out_in_the_order_in_which_they_came() -> None:
    box = mailbox()
    for number, policy in enumerate(
        (DropPolicy.LOSSLESS, DropPolicy.PICTURE, DropPolicy.ALWAYS, DropPolicy.MAP)
    ):
        box.put((policy, 10, str(number)))
    assert box.n_bytes == 40
    assert names_in(box) == ["0", "1", "2", "3"]
    assert box.n_bytes == 0


def test_the_newest_frame_wins_with_and_without_overflow() -> None:
    box = mailbox()
    for number in range(3):
        box.put((DropPolicy.LATEST_WINS, 1, f"frame {number}"))
        box.put((DropPolicy.LOSSLESS, 1, f"sample {number}"))
    assert (box.n_dropped, box.n_overflowed) == (2, 0)
    assert names_in(box) == ["sample 0", "sample 1", "frame 2", "sample 2"]


def test_pictures_go_first_then_the_map_then_the_rest_but_never_an_order() -> None:
    box = mailbox(60)
    policies = (
        DropPolicy.ALWAYS, DropPolicy.LOSSLESS, DropPolicy.MAP,
        DropPolicy.PICTURE, DropPolicy.PICTURE, DropPolicy.LOSSLESS,
    )  # fmt: skip
    for number, policy in enumerate(policies):
        box.put((policy, 10, str(number)))
    box.put((DropPolicy.LOSSLESS, 10, "6"))
    assert box.n_overflowed == 1
    box.put((DropPolicy.LOSSLESS, 25, "7"))
    assert (box.n_overflowed, box.n_bytes) == (4, 55)
    assert names_in(box) == ["0", "5", "6", "7"]


def test_a_message_larger_than_the_capacity_is_let_in_alone() -> None:
    box = mailbox(10)
    box.put((DropPolicy.PICTURE, 50, "large"))
    assert box.n_overflowed == 0
    box.put((DropPolicy.PICTURE, 60, "larger"))
    assert box.n_overflowed == 1
    assert names_in(box) == ["larger"]


def test_a_stage_that_takes_nothing_for_an_hour_stays_within_its_capacity() -> None:
    box: Mailbox[Parcel] = Mailbox(
        lambda p: DROPPED.get(p.kind, DropPolicy.LOSSLESS), lambda p: p.n_bytes, 1 << 20
    )
    box.put(Parcel.of(Setup(Config(), CAMERA)))
    for t_ns in range(20_000):
        box.put(Parcel.of(AttitudeSample(t_ns, np.array([1.0, 0, 0, 0]))))
    assert box.n_bytes <= 1 << 20
    assert box.n_overflowed > 10_000
    box.put(Parcel.of(Finish(hurry=True)))
    first = box.get()
    assert first is not None and isinstance(first.open(), Setup), "its setup comes first"


SMALL, LARGE, ORDER = DropPolicy.LOSSLESS, DropPolicy.PICTURE, DropPolicy.ALWAYS
LONG_S = 60.0


def test_small_messages_are_taken_together_and_all_in_their_order() -> None:
    box = mailbox(1000)
    policies = ORDER, SMALL, SMALL, LARGE, SMALL, SMALL, SMALL, SMALL, LARGE, LARGE
    for number, policy in enumerate(policies):
        box.put((policy, 10, str(number)))
    box.close()
    taken: list[str] = []
    while found := box.collect(30, 0.0):
        taken.append("".join(name for _, _, name in found))
    assert taken == ["0", "12", "3", "456", "7", "8", "9"]


@pytest.mark.parametrize(
    "ends_it", [(LARGE, 1, "frame"), (ORDER, 1, "order"), (SMALL, 21, "many"), None]
)
def test_small_messages_gather_until_there_is_more(ends_it: Sent | None) -> None:
    box = mailbox()
    taken: list[list[Sent]] = []
    taker = threading.Thread(target=lambda: taken.append(box.collect(30, LONG_S)))
    taker.start()
    small = (SMALL, 10, "small")
    box.put(small)
    taker.join(0.1)
    assert taker.is_alive() and not taken, "a small message wakes nobody"
    if ends_it is None:
        box.close()
    else:
        box.put(ends_it)
    taker.join(LONG_S / 2)
    assert taken == [[small]]


def test_small_messages_gather_no_longer_than_that() -> None:
    box = mailbox()
    box.put((SMALL, 10, "0"))
    assert len(box.collect(30, LONG_S)) == 1, "what waits is taken at once"
    threading.Timer(0.01, box.put, [(SMALL, 10, "1")]).start()
    assert [name for _, _, name in box.collect(30, 0.05)] == ["1"]


def test_what_is_put_together_is_there_before_anybody_is_woken() -> None:
    box = mailbox(1000)
    taken: list[list[Sent]] = []
    taker = threading.Thread(target=lambda: taken.append(box.collect(1000, 0.0)))
    taker.start()
    while not box.is_idle:
        taker.join(0.001)
    several = [(SMALL, 10, str(number)) for number in range(50)]
    box.put_all(several)
    taker.join()
    assert taken == [several]


def test_putting_together_waits_for_room_and_wakes_who_makes_it() -> None:
    box: Mailbox[Sent] = Mailbox(lambda sent: sent[0], lambda sent: sent[1], 100, waits=True)
    several = [(SMALL, 40, str(number)) for number in range(10)]
    putter = threading.Thread(target=box.put_all, args=(several,))
    taken: list[Sent | None] = []
    taker = threading.Thread(target=lambda: taken.extend(box.get() for _ in several))
    taker.start()
    while not box.is_idle:
        taker.join(0.001)
    putter.start()
    taker.join(LONG_S / 2)
    assert taken == several
    putter.join()


def test_it_is_idle_while_somebody_waits_for_the_next_message() -> None:
    box = mailbox()
    assert not box.is_idle, "nobody takes anything"
    taker = threading.Thread(target=box.get)
    taker.start()
    while not box.is_idle:
        taker.join(0.001)
    box.put((SMALL, 10, "0"))
    assert not box.is_idle, "it is on its way"
    taker.join()
    assert not box.is_idle
    box.close()
    assert box.get() is None and not box.is_idle


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (Frame(1, 1, np.zeros((4, 6), np.uint8), np.zeros((4, 6, 3), np.uint8)), 4 * 24),
        (
            MapUpdate(1, 1, dict.fromkeys(range(5), Pose.identity()), np.zeros((9, 3)), None),
            5 * ENTRY_BYTES + 216,
        ),
        (
            DepthMap(
                1, 1, (1.0, 1.0, 1.0, 1.0), np.zeros((4, 6), np.float32),
                np.zeros((4, 6), np.float32), np.zeros((4, 6), np.uint8),
                np.zeros((4, 6), np.float32), np.zeros((4, 6, 3), np.uint8), 1, {},
            ), 24 * 16,
        ),
        (None, 0),
    ],
)  # fmt: skip
def test_sizes(message: object, expected: int) -> None:
    assert size_bytes(message) == SMALL_BYTES + expected
