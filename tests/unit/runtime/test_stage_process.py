"""A stage's process: set up, offered messages, stopped, ended and asked to finish."""

from __future__ import annotations

import errno
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import psutil
import pytest

from companion.config import Config
from companion.messages import DepthMap, Frame
from companion.runtime import stage_start
from companion.runtime.parcel import Parcel
from companion.runtime.stage_process import StageProcess
from companion.runtime.stage_protocol import DriverAtWork, Finish, Progress, Setup
from companion.runtime.stage_start import NOT_STARTED, UNKNOWN_STATUS, Child, start_alone
from companion.runtime.stages import NICE_WITHOUT_LOSS, QUEUE_BYTES, UNREAD_BYTES, Stage
from companion.timing.clock import monotonic_s
from tests.support.flights.topic_flight import CAMERA
from tests.support.processes.stage_heard import SOON_S, Heard
from tests.support.processes.tiny_stages import (
    GIVEN_UP,
    LEFT_OVER,
    READER,
    SOURCE,
    UNUSABLE,
    Do,
    Said,
)

SETUP = Setup(Config(), CAMERA)
SIZE = 480, 640
FRAME_BYTES = 4 * SIZE[0] * SIZE[1]


class Tiny:
    """A process of a tiny stage, and what came of it."""

    def __init__(self, stage: Stage) -> None:
        self.heard, self.ended = Heard(), Heard()
        self.process = StageProcess(stage, start_alone, self.heard.parcel, self.ended.note)
        self.stage = self.process

    def do(self, what: str, detail: str = "") -> None:
        self.stage.offer(Parcel.of(Do(1, what, detail)))

    def until_up(self) -> None:
        """Wait until its work has begun."""
        self.do("say", "up")
        self.heard.until_said("told", "up")

    def until_reported(self, such: Callable[[Progress], bool]) -> None:
        """Wait until its newest report is as wanted."""
        until_s = monotonic_s() + SOON_S
        while (progress := self.stage.progress) is None or not such(progress):
            assert monotonic_s() < until_s, progress
            threading.Event().wait(0.005)

    def suspend(self) -> psutil.Process:
        """Stop the process, and wait until all its threads are: then it certainly takes nothing."""
        process = psutil.Process(self.process.pid)
        process.suspend()
        until_s = monotonic_s() + SOON_S
        threads = [Path(f"/proc/{process.pid}/task/{each.id}/stat") for each in process.threads()]
        while any(each.read_text().rpartition(")")[2].split()[0] != "T" for each in threads):
            assert monotonic_s() < until_s, "it does not stop"
            threading.Event().wait(0.002)
        return process

    def why(self) -> str:
        """Why it has ended, once it has."""
        self.ended.until(lambda: self.ended.all)
        (why,) = self.ended.all
        return str(why)


Start = Callable[[Stage], Tiny]


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    monkeypatch.setattr(stage_start, "CHILD", "tests.support.processes.tiny_stage_child")
    begun: list[Tiny] = []

    def started(stage: Stage) -> Tiny:
        begun.append(Tiny(stage))
        return begun[-1]

    yield started
    for tiny in begun:
        tiny.process.kill()
        assert not tiny.process.alive


def frame(seq: int) -> Parcel:
    return Parcel.of(Frame(seq, seq, np.zeros(SIZE, np.uint8), np.zeros((*SIZE, 3), np.uint8)))


def depth_map(number: int) -> Parcel:
    """Five megabytes, each its own."""
    floats = [np.full(SIZE, number, np.float32) for _ in range(3)]
    return Parcel.of(DepthMap(
        number, number, (500.0, 500.0, 320.0, 240.0), floats[0], floats[1],
        np.zeros(SIZE, np.uint8), floats[2], np.zeros((*SIZE, 3), np.uint8), 9, {},
    ))  # fmt: skip


def test_messages_are_answered_in_order_and_the_last_words_are_heard(start: Start) -> None:
    tiny = start(READER)
    tiny.do("say", "too early")  # before its setup
    assert tiny.stage.progress is None
    tiny.stage.begin(SETUP)
    for n in range(50):
        tiny.do("say", str(n))
    tiny.stage.ask_to_finish(Finish(hurry=False))
    tiny.do("say", "too late")
    assert tiny.stage.wait(SOON_S)
    assert tiny.why() == ""
    words = [("told", str(n)) for n in range(50)] + [("last words", "at leisure")]
    assert tiny.heard.all == [Said(0 if who == "last words" else 1, who, w) for who, w in words]
    assert tiny.stage.has_finished
    assert tiny.stage.n_dropped == 1
    assert not tiny.process.alive and tiny.process.driver is None


def test_what_dies_by_itself_says_why(start: Start, tmp_path: Path) -> None:
    ends = {
        ("exit", "3"): "ended with status 3",
        ("crash", ""): "killed by SIGSEGV",
        ("give up", ""): GIVEN_UP,
    }
    refusing = start(READER)
    refusing.stage.begin(Setup(Config(), CAMERA, tmp_path / UNUSABLE))
    begun = [(start(READER), told, why) for told, why in ends.items()]
    for tiny, told, _ in begun:
        tiny.stage.begin(SETUP)
        tiny.do("drive", "gpu")
        tiny.do(*told)
    for tiny, _, why in begun:
        assert tiny.why() == why
        assert not tiny.process.was_interrupted and not tiny.stage.has_finished
        failed, driver = tiny.stage.failed, tiny.process.driver
        assert (failed is not None) is (why == GIVEN_UP)
        if failed is not None:
            assert not failed.by_input
            assert driver is None, "it ended by what it says itself"
        else:
            assert driver is not None and (driver.identity, driver.named) == ("gpu", "the gpu")
    assert "cannot be used" in refusing.why()
    assert refusing.stage.failed is not None and refusing.stage.failed.by_input
    assert refusing.stage.progress is None


def test_a_process_without_its_threads_is_ended(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[Child] = []
    start_thread = threading.Thread.start

    def started(name: str, descriptor: int) -> Child:
        begun.append(start_alone(name, descriptor))
        return begun[-1]

    def refuse(thread: threading.Thread) -> None:
        if thread.name.startswith("from "):
            raise RuntimeError("can't start new thread")
        start_thread(thread)

    monkeypatch.setattr(threading.Thread, "start", refuse)
    with pytest.raises(RuntimeError):
        StageProcess(READER, started, lambda parcel: None, lambda why: None)
    assert [child.poll() for child in begun] == [-signal.SIGKILL]


def test_a_process_that_can_be_sent_nothing_more_is_told_of(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    send = Parcel.send

    def refuse(parcel: Parcel, to: socket.socket, flags: int = 0) -> None:
        if not refused:
            return send(parcel, to)
        raise OSError(errno.ENOBUFS, "No buffer space available")

    refused = False
    monkeypatch.setattr(Parcel, "send", refuse)
    tiny = start(READER)
    tiny.stage.begin(SETUP)
    tiny.do("drive", "gpu")
    tiny.until_up()
    refused = True
    tiny.do("say", "lost")
    assert tiny.why() == "nothing can be sent to it: No buffer space available"
    assert not tiny.process.alive
    assert tiny.process.driver is None, "it ended because it was hung up on"


def test_a_process_that_cannot_read_a_packet_ends(
    start: Start, capfd: pytest.CaptureFixture[str]
) -> None:
    tiny = start(READER)
    tiny.stage.begin(SETUP)
    tiny.until_up()
    tiny.process._socket.send(b"no parcel")
    assert tiny.why() == "ended with status 1"
    assert "struct.error" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("status", "is_blamed"),
    [
        (0, True), (3, True), (-signal.SIGSEGV, True), (-signal.SIGKILL, False),
        (UNKNOWN_STATUS, False), (NOT_STARTED, False),
    ],
)  # fmt: skip
def test_a_driver_is_blamed_for_an_end_that_is_known(status: int, is_blamed: bool) -> None:
    child: Any = SimpleNamespace(
        pid=None, poll=lambda: status, wait=lambda: status, kill=lambda: None
    )
    ended = Heard()
    process = StageProcess(READER, lambda name, descriptor: child, lambda parcel: None, ended.note)
    process._driver = DriverAtWork("gpu", "the gpu")
    ended.until(lambda: ended.all)
    assert (process.driver is not None) is is_blamed
    process.kill()


def test_what_gets_the_time_that_is_left_over_gets_more_to_begin(start: Start) -> None:
    """Else it would take minutes where nothing is left over; then its drivers stand back, too."""
    tiny = start(LEFT_OVER)
    tiny.stage.begin(SETUP)
    tiny.do("say how it began")
    tiny.heard.until_said(
        "began", f"policy {os.SCHED_OTHER}, nice {os.nice(0) + NICE_WITHOUT_LOSS}"
    )
    threads = psutil.Process(tiny.process.pid).threads()
    assert len(threads) > 3
    assert {os.sched_getscheduler(each.id) for each in threads} == {os.SCHED_IDLE}


def test_how_long_it_has_hung_and_its_end_by_interruption(start: Start) -> None:
    tiny = start(READER)
    assert tiny.stage.stalled_s(monotonic_s() + 100.0) == 0.0, "it has nothing to do"
    tiny.stage.begin(SETUP)
    assert tiny.stage.stalled_s(monotonic_s() + 100.0) == pytest.approx(100.0, abs=5.0)
    tiny.until_up()
    tiny.stage.offer(frame(7))
    tiny.heard.until_said("frame", "7")
    tiny.until_reported(lambda found: found.n_done == 1 and found.busy_since_s is None)
    assert tiny.stage.stalled_s(monotonic_s() + 100.0) == 0.0, "again it has nothing to do"
    tiny.do("drive", "gpu")
    tiny.do("say", "driven")
    tiny.heard.until_said("told", "driven")
    tiny.do("hang")
    offered_s = monotonic_s()
    assert tiny.stage.stalled_s(offered_s + 100.0) == pytest.approx(100.0, abs=5.0)
    tiny.process.interrupt("it hung")
    assert tiny.why() == "it hung"
    assert tiny.process.was_interrupted
    assert tiny.process.driver is not None, "which may be to blame"


def test_a_stage_that_is_asked_to_end_does_not_hang(start: Start) -> None:
    tiny = start(READER)
    tiny.stage.begin(SETUP)
    tiny.do("be slow to finish")
    tiny.stage.ask_to_finish(Finish(hurry=True))
    assert tiny.stage.stalled_s(monotonic_s() + 100.0) == 0.0
    assert not tiny.stage.wait(0.0)
    tiny.process.kill()
    assert tiny.why() == "", "it was asked to"
    assert not tiny.stage.has_finished and tiny.heard.texts("last words") == []


def test_frames_are_dropped_for_newer_ones_and_nothing_else_is(start: Start) -> None:
    tiny = start(SOURCE)
    tiny.stage.begin(SETUP)
    tiny.until_up()
    stopped = tiny.suspend()
    n = 6 * UNREAD_BYTES // FRAME_BYTES
    for seq in range(n):
        tiny.stage.offer(frame(seq))
        tiny.do("say", str(seq))
    waiting_bytes = tiny.stage.waiting_bytes
    assert waiting_bytes < 2 * FRAME_BYTES, "the newest only"
    n_dropped = tiny.stage.n_dropped
    assert n_dropped >= n - (UNREAD_BYTES // FRAME_BYTES + 3)
    stopped.resume()
    tiny.heard.until_said("told", str(n - 1))
    tiny.stage.ask_to_finish(Finish(hurry=True))
    assert tiny.stage.wait(SOON_S)
    seen = [int(text) for text in tiny.heard.texts("frame")]
    assert seen == sorted(seen) and seen[-1] == n - 1
    assert tiny.heard.texts("told") == ["up", *map(str, range(n))]
    assert 0 < len(seen) <= n - n_dropped


def test_small_messages_are_sent_together(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    packets: list[int] = []
    together = Parcel.send_together

    def counted(parcels: Sequence[Parcel], to: socket.socket) -> None:
        packets.append(len(parcels))
        together(parcels, to)

    tiny = start(READER)
    tiny.stage.begin(SETUP)
    tiny.until_up()
    monkeypatch.setattr(Parcel, "send_together", counted)
    for n in range(100):
        tiny.do("say", str(n))
    tiny.heard.until_said("told", "99")
    assert tiny.heard.texts("told") == ["up", *map(str, range(100))]
    assert sum(packets) == 100 and len(packets) < 50


def test_whoever_has_a_message_for_localisation_sends_it(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    tiny = start(SOURCE)
    tiny.stage.begin(SETUP)
    tiny.until_up()
    while not tiny.process._outbox._waiting.is_idle:
        threading.Event().wait(0.001)
    senders: list[threading.Thread] = []
    send = Parcel.send

    def noted(parcel: Parcel, to: socket.socket, flags: int = 0) -> None:
        senders.append(threading.current_thread())
        send(parcel, to, flags)

    monkeypatch.setattr(Parcel, "send", noted)
    tiny.do("say", "hello")
    tiny.stage.offer(frame(7))
    assert senders == [threading.current_thread()] * 2
    tiny.heard.until_said("frame", "7")
    assert tiny.stage.waiting_bytes == 0


def test_what_waits_for_a_process_that_takes_nothing_is_bounded(start: Start) -> None:
    tiny = start(READER)
    tiny.stage.begin(SETUP)
    tiny.until_up()
    tiny.suspend()
    before_bytes = psutil.Process().memory_info().rss
    for number in range(100):
        tiny.stage.offer(depth_map(number))
    assert 0 < tiny.stage.waiting_bytes <= QUEUE_BYTES
    assert psutil.Process().memory_info().rss - before_bytes < 2 * QUEUE_BYTES
    assert tiny.stage.n_dropped >= 100 - (QUEUE_BYTES + UNREAD_BYTES) // 5_000_000 - 3
    assert tiny.stage.stalled_s(monotonic_s() + 100.0) > 95.0
