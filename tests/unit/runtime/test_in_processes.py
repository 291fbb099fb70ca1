"""The executor of a live flight: who gets what, who begins again, and how it all ends."""

from __future__ import annotations

import errno
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import psutil
import pytest

from companion.config import Config
from companion.flight_notes import LinkReads
from companion.messages import Frame, MapUpdate
from companion.runtime import gathered_samples, in_processes, stage_start
from companion.runtime.gathered_samples import Samples
from companion.runtime.in_processes import LONGEST_WAIT_S, InProcesses, Supervisor, pause_s
from companion.runtime.parcel import Parcel
from companion.runtime.stage_process import StageProcess
from companion.runtime.stage_protocol import Finish, SetLoadLevel, Setup
from companion.runtime.stage_start import Child, Start, start_alone
from companion.runtime.stages import Stage
from companion.telemetry import ArmedSample, LandedSample
from tests.support.flights.topic_flight import CAMERA
from tests.support.processes.stage_heard import SOON_S, Heard
from tests.support.processes.tiny_stages import (
    GIVEN_UP,
    READER,
    SOURCE,
    STAGES,
    UNUSABLE,
    WRITER,
    Do,
    Said,
)

TINY_CHILD = "tests.support.processes.tiny_stage_child"


@dataclass(frozen=True)
class Began:
    """A setup was asked for."""

    stage: str
    n_restarted: int
    failed_devices: tuple[str, ...]


@dataclass(frozen=True)
class Ended:
    """A stage has ended: `restarted`, `over` or `unusable`."""

    how: str
    why: str


class Flight:
    """Tiny stages in a flight: what one of them says goes to all that listen, as in the daemon."""

    def __init__(
        self, *rows: Stage, folder: Path | None = None, start: Start = start_alone
    ) -> None:
        self.heard, self._folder = Heard(), folder
        note = self.heard.note
        self.processes = InProcesses(
            rows or STAGES,
            start,
            Supervisor(
                self._setup, self._hear,
                lambda stage, why: note(Ended("restarted", f"{stage.name}: {why}")),
                lambda why: note(Ended("over", why)),
                lambda why: note(Ended("unusable", why)),
            ),
        )  # fmt: skip
        self.processes.start()

    def close(self) -> None:
        """End what is left of it."""
        self.processes.hurry()
        self.processes.finish(lambda stage: Finish(hurry=True))

    def do(self, name: str, what: str, detail: str = "") -> None:
        """Tell one stage to do something."""
        self.processes.order(name, Do(1, what, detail))

    def until_up(self, *names: str) -> None:
        """Wait until the work of stages has begun."""
        for name in names:
            self.processes.order(name, Do(1, "say", f"{name} up"))
        for name in names:
            self.heard.until_said("told", f"{name} up")

    def process(self, name: str) -> StageProcess:
        """Process of a stage."""
        return self.processes.by_name[name]

    def pids(self) -> list[int]:
        """Of all processes."""
        pids = [self.process(name).pid for name in self.processes.by_name]
        return [pid for pid in pids if pid is not None]

    def until_ended(self, how: str, why: str) -> None:
        self.heard.until(lambda: Ended(how, why) in self.heard.all)

    def began(self, name: str) -> list[Began]:
        return [each for each in self.heard.all if isinstance(each, Began) and each.stage == name]

    def _setup(self, stage: Stage, n_restarted: int, failed_devices: dict[str, str]) -> Setup:
        self.heard.note(Began(stage.name, n_restarted, tuple(failed_devices.values())))
        return Setup(Config(), CAMERA, self._folder)

    def _hear(self, parcel: Parcel) -> None:
        self.heard.parcel(parcel)
        self.processes.publish(parcel)


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage_start, "CHILD", TINY_CHILD)


Fly = Callable[..., Flight]


@pytest.fixture
def fly() -> Iterator[Fly]:
    """Begins a flight, which is ended."""
    begun: list[Flight] = []

    def begin(*rows: Stage, folder: Path | None = None, start: Start = start_alone) -> Flight:
        begun.append(Flight(*rows, folder=folder, start=start))
        begun[-1].processes.fly()
        return begun[-1]

    yield begin
    for flight in begun:
        flight.close()


def endings(flight: Flight) -> list[Ended]:
    return [each for each in flight.heard.all if isinstance(each, Ended)]


def map_update(revision: int) -> Parcel:
    return Parcel.of(MapUpdate(revision, 1, {}, np.zeros((0, 3)), None))


@pytest.fixture(scope="module")
def flying() -> Iterator[Flight]:
    """One flight for the tests of what goes on during one."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(stage_start, "CHILD", TINY_CHILD)
        flight = Flight(SOURCE, READER, replace(WRITER, answer_s=0.2))
        with closing(flight):
            assert {each.stage for each in flight.heard.all} == {"source", "reader"}, "stand by"
            flight.processes.publish(map_update(1))
            flight.heard.until_said("map", "1")
            assert not flight.began("writer"), "it begins with the flight"
            flight.processes.fly()
            flight.until_up("source", "reader", "writer")
            yield flight


@pytest.mark.continues
def test_messages_go_to_who_listens(flying: Flight) -> None:
    flying.processes.publish(Parcel.of(Do(1, "say", "both")))
    flying.heard.until(lambda: flying.heard.texts("told").count("both") == 2)
    # the writer listens to what these say, and hears it once each
    flying.heard.until(lambda: flying.heard.texts("heard").count("told both") == 2)
    assert flying.processes.up
    flying.processes.muted.add("reader")
    flying.processes.publish(map_update(10))
    flying.do("reader", "say", "muted")  # what is for it alone it gets still
    flying.processes.order("nobody", Do(1, "say", "to nobody"))
    flying.heard.until_said("told", "muted")
    flying.heard.until_said("map", "10")
    assert flying.heard.texts("map").count("10") == 1, "the writer got it, the reader did not"
    flying.processes.muted.discard("reader")
    flying.processes.bring_up_to_date("reader")
    flying.heard.until(lambda: flying.heard.texts("map").count("10") == 2)
    assert "to nobody" not in flying.heard.texts("told")


@pytest.mark.continues
def test_a_stage_that_dies_begins_again_with_the_newest_map(flying: Flight) -> None:
    flying.processes.publish(map_update(20))
    flying.processes.publish(map_update(21))
    flying.heard.until(lambda: flying.heard.texts("map").count("21") == 2)
    source = flying.process("source")
    flying.do("reader", "drive", "gpu")
    flying.do("reader", "crash")
    flying.until_ended("restarted", "reader: killed by SIGSEGV")
    flying.heard.until(lambda: flying.heard.texts("map").count("21") == 3)
    # without the device whose driver was at work
    assert flying.began("reader")[1:] == [Began("reader", 1, ("the gpu: killed by SIGSEGV",))]
    assert flying.heard.texts("map").count("20") == 2, "the newest only"
    assert flying.processes.n_restarted["reader"] == 1
    assert flying.process("source") is source and source.alive
    assert not flying.processes.over and flying.processes.up


@pytest.mark.continues
def test_a_stage_that_begins_again_has_its_load_level(flying: Flight) -> None:
    flying.processes.order("reader", SetLoadLevel(0.5))
    flying.processes.order("reader", SetLoadLevel(0.0))
    flying.heard.until_said("load", "0.0")
    n_restarted = flying.processes.n_restarted["reader"]
    flying.do("reader", "exit", "5")
    flying.heard.until(lambda: flying.heard.texts("load") == ["0.5", "0.0", "0.0"])
    assert flying.processes.n_restarted["reader"] == n_restarted + 1


@pytest.mark.continues
def test_a_stage_that_hangs_is_ended_and_begins_again(flying: Flight) -> None:
    flying.do("writer", "drive", "disk")
    flying.do("writer", "hang")
    until_s = time.monotonic() + SOON_S
    while not flying.began("writer")[1:]:
        assert time.monotonic() < until_s
        flying.processes.end_stalled()
        threading.Event().wait(0.01)
    why = endings(flying)[-1].why
    assert why.startswith("writer: it hung for ")
    again = flying.began("writer")[1]
    assert again.n_restarted == 1
    # the first time others may be to blame for it
    assert not any("disk" in device for device in again.failed_devices)
    flying.until_up("writer")
    assert flying.processes.n_restarted["source"] == 0, "what has nothing to do is left alone"


def test_without_its_source_the_flight_is_over(fly: Fly) -> None:
    flight = fly(SOURCE, READER)
    flight.until_up("source", "reader")
    flight.do("source", "exit", "9")
    flight.until_ended("over", "ended with status 9")
    assert flight.processes.over
    flight.processes.add(WRITER)
    assert "writer" not in flight.processes.by_name
    flight.do("reader", "exit", "8")
    until_s = time.monotonic() + SOON_S
    while flight.process("reader").alive:
        assert time.monotonic() < until_s
        threading.Event().wait(0.005)
    # what had something to give gives it; nothing begins again
    assert flight.processes.finish(lambda stage: Finish(hurry=False)) == {}
    assert [each.how for each in flight.heard.all if isinstance(each, Ended)] == ["over"]
    assert flight.processes.n_restarted == {"source": 0, "reader": 0}


def test_what_cannot_start_because_of_the_user_is_told(
    fly: Fly, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(in_processes, "pause_s", lambda n_before: 200.0)
    flight = fly(READER, folder=tmp_path / UNUSABLE)
    flight.heard.until(lambda: any(e.how == "unusable" for e in endings(flight)))
    unusable = next(each for each in endings(flight) if each.how == "unusable")
    assert str(tmp_path / UNUSABLE) in unusable.why
    flight.heard.until(lambda: len(endings(flight)) == 3)
    # it is tried again, and then it is not said again
    assert [each.how for each in endings(flight)] == ["restarted", "unusable", "restarted"]
    begun_s = time.monotonic()
    flight.close()  # does not wait for the pause before the next
    assert time.monotonic() - begun_s < 100.0
    assert len(flight.began("reader")) == 2


def test_a_source_that_cannot_start_because_of_the_user_is_told_before_the_end(
    fly: Fly, tmp_path: Path
) -> None:
    flight = fly(SOURCE, folder=tmp_path / UNUSABLE)
    flight.heard.until(lambda: any(each.how == "over" for each in endings(flight)))
    assert [each.how for each in endings(flight)] == ["unusable", "over"]
    assert str(tmp_path / UNUSABLE) in endings(flight)[0].why


def test_where_no_process_can_be_started_another_start_follows(fly: Fly) -> None:
    n_refused = 0

    def start(name: str, descriptor: int) -> Child:
        nonlocal n_refused
        if flight is not None and n_refused < 2:
            n_refused += 1
            raise OSError(errno.EAGAIN, "Resource temporarily unavailable")
        return start_alone(name, descriptor)

    flight: Flight | None = None
    flight = fly(READER, start=start)
    flight.until_up("reader")
    flight.do("reader", "exit", "7")
    flight.heard.until(lambda: len(flight.began("reader")) == 2)
    refused = "reader: no process could be started for it: Resource temporarily unavailable"
    assert [each.why for each in endings(flight)] == [
        "reader: ended with status 7", refused, refused
    ]  # fmt: skip
    assert flight.processes.n_restarted == {"reader": 1}


@pytest.mark.parametrize(
    "refusal",
    [OSError(errno.EAGAIN, "Resource temporarily unavailable"),
     RuntimeError("can't start new thread")],
)  # fmt: skip
def test_where_one_stage_cannot_be_started_none_is_left(refusal: Exception) -> None:
    begun: list[Child] = []

    def start(name: str, descriptor: int) -> Child:
        if len(begun) == 2:
            raise refusal
        begun.append(start_alone(name, descriptor))
        return begun[-1]

    with pytest.raises(type(refusal)):
        Flight(start=start)
    assert [child.poll() for child in begun] == [-signal.SIGKILL] * 2


def test_a_source_that_ends_as_it_is_started_is_told_each_time(fly: Fly) -> None:
    """Its thread may be there before the executor knows the process."""

    def start(name: str, descriptor: int) -> Child:
        child = subprocess.Popen(["true"])
        child.wait()
        return child

    for _ in range(20):
        fly(SOURCE, start=start).until_ended("over", "ended with status 0")


def test_a_stage_that_cannot_be_added_now_can_be_later(fly: Fly) -> None:
    refused = False

    def start(name: str, descriptor: int) -> Child:
        nonlocal refused
        if name == WRITER.name and not refused:
            refused = True
            raise OSError(errno.EAGAIN, "Resource temporarily unavailable")
        return start_alone(name, descriptor)

    flight = fly(SOURCE, READER, start=start)
    flight.until_up("source", "reader")
    with pytest.raises(OSError, match="unavailable"):
        flight.processes.add(WRITER)
    assert set(flight.processes.by_name) == {"source", "reader"}
    flight.until_up("source", "reader")  # which is passed on to all that listen
    flight.processes.add(WRITER)
    flight.until_up("writer")


def test_pauses_between_starts_grow_to_half_a_minute() -> None:
    assert [pause_s(n) for n in (1, 2, 5, 6, 7)] == [1.0, 2.0, 16.0, LONGEST_WAIT_S, LONGEST_WAIT_S]
    assert pause_s(5000) == LONGEST_WAIT_S


def test_last_words_of_sources_reach_the_others_before_these_end() -> None:
    flight = Flight()
    with closing(flight):
        flight.processes.fly()
        flight.until_up("source", "reader")
        asked: list[str] = []
        pids = flight.pids()

        def finish_of(stage: Stage) -> Finish:
            asked.append(stage.name)
            return Finish(flight.processes.hurried)

        assert flight.processes.finish(finish_of) == {}
        assert asked == ["source", "reader", "writer"]
        assert flight.heard.texts("last words") == ["at leisure"] * 3
        assert flight.heard.texts("heard").count("last words at leisure") >= 1
        spoken = [e for e in flight.heard.all if isinstance(e, Said)]
        assert spoken.index(Said(0, "last words", "at leisure")) < spoken.index(
            Said(0, "heard", "last words at leisure")
        )
        assert not any(psutil.pid_exists(pid) for pid in pids)


@pytest.mark.parametrize("hurried", [False, True])
def test_stages_that_are_late_are_named_and_ended(hurried: bool) -> None:
    """By the time of the table, and where the daemon is to end by the shorter one."""
    flight = Flight(
        replace(SOURCE, hurried_s=SOON_S),
        replace(READER, finish_s=300.0 if hurried else 0.3, hurried_s=0.3),
    )
    with closing(flight):
        flight.processes.fly()
        flight.until_up("source", "reader")
        flight.do("source", "fail to finish")
        flight.do("reader", "be slow to finish")
        if hurried:
            flight.processes.hurry()
        pids = flight.pids()
        begun_s = time.monotonic()
        late = flight.processes.finish(lambda stage: Finish(flight.processes.hurried))
        assert late == {"source": GIVEN_UP, "reader": ""}
        assert 0.3 <= time.monotonic() - begun_s < 100.0
        assert flight.heard.texts("last words") == []
        assert not any(psutil.pid_exists(pid) for pid in pids)


def test_without_a_flight_nothing_is_finished() -> None:
    flight = Flight(SOURCE)
    flight.until_up("source")
    pids = flight.pids()
    assert flight.processes.finish(lambda stage: Finish(hurry=False)) == {}
    assert flight.heard.texts("last words") == []
    assert not any(psutil.pid_exists(pid) for pid in pids)


def test_samples_gather_until_another_message(fly: Fly, monkeypatch: pytest.MonkeyPatch) -> None:
    samples = replace(READER, listens=(*READER.listens, ArmedSample, LandedSample))
    flight = fly(replace(SOURCE, listens=(*SOURCE.listens, ArmedSample)), samples)
    flight.until_up("source", "reader")
    offered: dict[str, list[list[int]]] = {"source": [], "reader": []}
    for name, kept in offered.items():
        process = flight.process(name)

        def note(
            parcel: Parcel, kept: list[list[int]] = kept, process: StageProcess = process
        ) -> None:
            if parcel.kind == Samples.__name__:
                kept.append([each.t_ns for each in parcel.open().parts])
            StageProcess.offer(process, parcel)

        monkeypatch.setattr(process, "offer", note)
    monkeypatch.setattr(gathered_samples, "HELD_S", 60.0)
    frame = Frame(1, 1, np.zeros((4, 6), np.uint8), np.zeros((4, 6, 3), np.uint8))
    for t_ns in range(70):
        flight.processes.take(ArmedSample(t_ns, True))
    flight.processes.take(LinkReads(0, ()))  # makes none of them go
    flight.processes.take(LandedSample(70, True))
    flight.processes.publish(Parcel.of(frame))
    assert offered["source"] == [list(range(64)), list(range(64, 70))]
    assert offered["reader"] == [list(range(64)), list(range(64, 71))]
    flight.heard.until(lambda: len(flight.heard.texts("frame")) == 2)
    said = sorted(map(int, flight.heard.texts("sample")))
    assert said == sorted([*range(70), *range(71)])
    monkeypatch.setattr(gathered_samples, "HELD_S", 0.0)
    flight.processes.take(ArmedSample(71, True))
    flight.heard.until(lambda: flight.heard.texts("sample").count("71") == 2)


def test_a_stage_may_get_a_frame_a_second_while_others_get_all(
    fly: Fly, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight = fly(SOURCE, READER)
    flight.until_up("source", "reader")
    offered: dict[str, list[int]] = {"source": [], "reader": []}
    for name, tenths in offered.items():
        monkeypatch.setattr(
            flight.process(name), "offer",
            lambda parcel, tenths=tenths: tenths.append(parcel.open().seq),
        )  # fmt: skip
    flight.processes.frames_apart_s = {"reader": 1.0}
    grey, rgb = np.zeros((4, 6), np.uint8), np.zeros((4, 6, 3), np.uint8)
    for tenth in range(26):
        flight.processes.publish(Parcel.of(Frame(tenth, tenth * 100_000_000, grey, rgb)))
    assert offered == {"source": list(range(26)), "reader": [10, 20]}


def test_a_flight_ends_with_its_last_samples(fly: Fly, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gathered_samples, "HELD_S", 60.0)
    flight = fly(replace(SOURCE, listens=(*SOURCE.listens, ArmedSample)))
    flight.until_up("source")
    flight.processes.take(ArmedSample(7, True))
    flight.processes.finish(lambda stage: Finish(hurry=False))
    assert flight.heard.texts("sample") == ["7"]
