"""Stages in one process: who gets what and when, and a dense map that fails or is slow."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest

from companion.config import Config
from companion.geometry.transforms import Pose
from companion.messages import Frame, KeyframeAdded, Message, PointChunk, Track, TrackState, Warned
from companion.runtime import in_order
from companion.runtime.in_order import (
    DEPTH_FAILED,
    FRAMES_AHEAD,
    InOrder,
    in_order_of_time,
)
from companion.runtime.stage_protocol import Finish, Setup
from companion.runtime.stage_thread import ROOM_BYTES
from companion.runtime.stage_work import Work
from companion.runtime.stages import stage_named
from companion.telemetry import RangeSample
from tests.support.flights.topic_flight import CAMERA

MS = 1_000_000
NAMES = ("localisation", "depth", "results")
NOTHING = np.zeros((0, 3), np.float32)


def frame(seq: int, t_ns: int, side: int = 2) -> Frame:
    return Frame(seq, t_ns, np.zeros((side, side), np.uint8), np.zeros((side, side, 3), np.uint8))


def chunk(keyframe_id: int) -> PointChunk:
    none = np.zeros(0, np.float32)
    return PointChunk(
        keyframe_id, keyframe_id, NOTHING, NOTHING.astype(np.uint8), none, NOTHING, none
    )


class Fake(Work):
    """A stage that says what it got, and gives what it is told to."""

    def __init__(self, name: str, got: list[str], gives: Callable[[Any], Iterable[Any]]) -> None:
        super().__init__()
        self._name, self._got, self._gives = name, got, gives

    def step(self, message: Any) -> Iterable[Any]:
        self._got.append(f"{self._name} {type(message).__name__}")
        return self._gives(message)

    def finish(self, finish: Finish) -> Iterable[Any]:
        self._got.append(f"{self._name} finishes")
        return self._gives(finish)


def nothing(message: Any) -> list[Any]:
    return []


def stages(
    monkeypatch: pytest.MonkeyPatch, **gives: Callable[[Any], Iterable[Any]]
) -> tuple[InOrder, list[str], list[Message]]:
    """Stages that say what they got, and all messages that passed."""
    got: list[str] = []
    passed: list[Message] = []

    class Module:
        def __init__(self, name: str) -> None:
            self._name = name

        def work(self, setup: Setup) -> Work:
            return Fake(self._name, got, gives.get(self._name, nothing))

    monkeypatch.setattr(in_order, "module_of", Module)
    made = InOrder(map(stage_named, NAMES), Setup(Config(), CAMERA), passed.append, print)
    return made, got, passed


def finish(_stage: object) -> Finish:
    return Finish(hurry=False)


def test_a_frame_comes_after_all_telemetry_up_to_its_time() -> None:
    samples = [RangeSample(t * MS, 1.0) for t in (0, 5, 10, 11, 30)]
    frames = [frame(0, 10 * MS), frame(1, 20 * MS)]
    merged = [(m.t_ns // MS, isinstance(m, Frame)) for m in in_order_of_time(samples, frames)]
    assert merged == [
        (0, False), (5, False), (10, False), (10, True), (11, False), (20, True), (30, False),
    ]  # fmt: skip


def test_an_image_is_there_before_its_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    def poses(message: Any) -> list[Message]:
        return [Track(1, 1, TrackState.LOST)] if isinstance(message, Frame) else []

    made, got, passed = stages(monkeypatch, localisation=poses)
    made.feed(frame(1, 1))
    made.finish(finish)
    without_depth = [each for each in got if not each.startswith("depth")]
    assert without_depth == [
        "results Frame", "localisation Frame", "results Track", "localisation finishes",
        "results finishes",
    ]  # fmt: skip
    assert [type(each) for each in passed] == [Frame, Track]


def test_a_stage_gets_what_it_listens_to_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    made, got, _ = stages(monkeypatch)
    for message in (RangeSample(1, 1.0), Warned(1, "a gap"), chunk(1), frame(2, 2)):
        made.feed(message)
    made.finish(finish)
    assert [each.split()[1] for each in got if each.startswith("localisation")] == [
        "RangeSample", "Frame", "finishes",
    ]  # fmt: skip
    assert [each.split()[1] for each in got if each.startswith("depth")] == ["Frame", "finishes"]
    assert [each.split()[1] for each in got if each.startswith("results")] == [
        "RangeSample", "Warned", "PointChunk", "Frame", "finishes",
    ]  # fmt: skip


def test_the_final_map_comes_after_the_last_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are made with the map of their own time."""
    last = KeyframeAdded(9, 9, 9, Pose.identity(), np.zeros((0, 3)))
    made, got, passed = stages(
        monkeypatch,
        localisation=lambda m: [last] if isinstance(m, Finish) else [],
        depth=lambda m: [chunk(3)] if isinstance(m, Finish) else [],
    )
    made.finish(finish)
    assert [type(each) for each in passed] == [PointChunk, KeyframeAdded]
    assert "depth KeyframeAdded" not in got


@pytest.mark.parametrize("where", [Frame, Finish])
def test_a_dense_map_that_fails_is_told_once_and_nobody_waits(
    monkeypatch: pytest.MonkeyPatch, where: type
) -> None:
    def fails(message: Any) -> list[Any]:
        if isinstance(message, where):
            raise ValueError("no room")
        return []

    made, got, passed = stages(monkeypatch, depth=fails)
    for seq in range(300):
        made.feed(frame(seq, seq))
    made.finish(finish)
    assert isinstance(made.depth_fault, ValueError)
    told = [each for each in passed if isinstance(each, Warned)]
    assert [(each.what, each.detail) for each in told] == [(DEPTH_FAILED, "ValueError: no room")]
    assert got.count("localisation Frame") == 300
    assert got[-1] == "results finishes"


def test_results_are_written_where_localisation_fails_at_the_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fails(message: Any) -> list[Any]:
        if isinstance(message, Finish):
            raise ValueError("no map")
        return []

    made, got, _ = stages(monkeypatch, localisation=fails)
    with pytest.raises(ValueError, match="no map"):
        made.finish(finish)
    assert got == ["localisation finishes", "depth finishes", "results finishes"]


def test_whoever_feeds_waits_for_depth_and_nothing_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    may_go_on = threading.Event()

    def slow(message: Any) -> list[Any]:
        may_go_on.wait(30)
        return []

    side = 2000
    made, got, _ = stages(monkeypatch, depth=slow)
    n_fed = 0
    fed = threading.Condition()

    def feed() -> None:
        nonlocal n_fed
        for seq in range(20):
            made.feed(frame(seq, seq, side))
            with fed:
                n_fed += 1
                fed.notify_all()

    feeder = threading.Thread(target=feed)
    feeder.start()
    n_room = ROOM_BYTES // (4 * side * side)
    with fed:
        assert fed.wait_for(lambda: n_fed >= n_room, 30)
    assert n_fed <= n_room + 2
    may_go_on.set()
    feeder.join(30)
    made.finish(finish)
    assert got.count("depth Frame") == 20


def test_frames_are_seen_ahead_and_pass_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recording that breaks off gives all that came before."""
    made, _, _ = stages(monkeypatch)
    seen: list[int] = []
    monkeypatch.setattr(made.works["localisation"], "look_ahead", lambda f: seen.append(f.seq))

    def recorded() -> Iterable[Message]:
        for seq in range(8):
            yield RangeSample(seq * MS, 1.0)
            yield frame(seq, seq * MS)
        raise OSError("the disk is gone")

    passed: list[Message] = []
    with pytest.raises(OSError, match="gone"):
        for message in made.looked_ahead(recorded()):
            passed.append(message)
            if isinstance(message, Frame):
                assert seen[-1] == min(message.seq + FRAMES_AHEAD, 7)
    assert [m.t_ns for m in passed] == [seq * MS for seq in range(8) for _ in range(2)]
    assert all(isinstance(m, Frame) == bool(n % 2) for n, m in enumerate(passed))
    made.finish(lambda stage: Finish(hurry=False))
