"""Camera supervisor with a scripted source."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
import pytest

from companion.config import CameraConfig
from companion.errors import ConfigError, FlightError, SourceError
from companion.messages import Frame, Warned
from companion.timing.clock import FlightClock
from drivers.camera import camera_feed
from drivers.camera.camera_feed import CameraFeed
from drivers.camera.camera_source import EndOfPictures, Picture
from tests.support.waiting import PATIENCE_S

STEP_S = 0.01


class ToldSource:
    """Gives a new picture every 10 ms, until it is told otherwise."""

    live = True
    start_s = 0.4
    silent_s = 0.15

    def __init__(self) -> None:
        self.name = "told"
        self.n_dropped = 0
        self.remarks: list[str] = []
        self.n_opened = 0
        self.is_open = False
        self.opening: Callable[[], None] = lambda: None
        self.making: Callable[[Picture], Picture | None] = lambda picture: picture
        self._rng = np.random.default_rng(1)

    def open(self) -> None:
        self.opening()
        self.n_opened += 1
        self.is_open = True

    def read(self, timeout_s: float) -> Picture | None:
        assert self.is_open
        time.sleep(STEP_S)
        grey = self._rng.integers(0, 255, (48, 64), np.uint8)
        return self.making(Picture(time.monotonic_ns(), grey, np.dstack([grey] * 3)))

    def close(self) -> None:
        self.is_open = False


@dataclass
class Run:
    source: ToldSource
    feed: CameraFeed
    clock: FlightClock
    frames: list[Frame] = field(default_factory=list)
    warned: list[Warned] = field(default_factory=list)

    def told(self) -> list[str]:
        return [each.what for each in self.warned]

    def until(self, true: Callable[[], bool], limit_s: float = PATIENCE_S) -> None:
        deadline_s = time.monotonic() + limit_s
        while not true():
            assert time.monotonic() < deadline_s, (self.feed.health, self.warned)
            time.sleep(0.002)

    def more(self) -> None:
        """Wait until another picture was handed on."""
        n = len(self.frames)
        self.until(lambda: len(self.frames) > n)

    def more_than(self, seconds: float) -> None:
        """Wait until pictures of so long a time were handed on."""
        self.more()
        beyond_ns = self.frames[-1].t_ns + round(seconds * 1e9)
        self.until(lambda: self.frames[-1].t_ns > beyond_ns)


@contextmanager
def running(source: ToldSource | None = None, **keys: float | str) -> Iterator[Run]:
    source, clock = source or ToldSource(), FlightClock()
    config = CameraConfig(**{"rate_hz": 100.0, **keys})  # type: ignore[arg-type]
    frames: list[Frame] = []
    warned: list[Warned] = []
    feed = CameraFeed(source, clock, config, frames.append, warned.append)
    feed.start()
    try:
        yield Run(source, feed, clock, frames, warned)
    finally:
        feed.stop()
    assert not source.is_open


@pytest.fixture(autouse=True)
def faster(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera_feed, "RETRY_S", 0.05)
    monkeypatch.setattr(camera_feed, "INVALID_S", 0.4)
    monkeypatch.setattr(camera_feed, "FROZEN_S", 0.2)


def test_pictures_become_frames_on_the_flights_clock() -> None:
    with running(stamp_offset_ms=-20.0) as run:
        run.until(lambda: len(run.frames) > 5)
        health = run.feed.health
    assert [frame.seq for frame in run.frames] == list(range(len(run.frames)))
    behind_ns = run.clock.now_ns() - run.frames[-1].t_ns
    assert 20e6 < behind_ns < 1e9
    assert np.all(np.diff([frame.t_ns for frame in run.frames]) > 0)
    assert (health.state, health.n_dropped, health.name) == ("running", 0, "camera")
    assert health.rate_hz > 20
    assert run.feed.size == (64, 48)
    assert run.warned == []


def test_a_camera_that_comes_later() -> None:
    source = ToldSource()

    n_tried = 0

    def missing() -> None:
        nonlocal n_tried
        n_tried += 1
        raise SourceError("told: not plugged in")

    source.opening = missing
    with running(source) as run:
        run.until(lambda: n_tried > 3)
        assert str(run.feed.health.state) == "missing"
        assert run.told() == [camera_feed.MISSING]  # once, not at every attempt
        source.opening = lambda: None
        run.more()
        assert run.feed.health.state == "running"


def test_a_camera_that_can_never_be_ends_the_thread() -> None:
    source = ToldSource()

    def never() -> None:
        raise ConfigError("told: no such size")

    source.opening = never
    with running(source) as run:
        run.until(lambda: run.feed.fault is not None)
        time.sleep(0.1)
    assert str(run.feed.fault) == "told: no such size"
    assert run.feed.health.state == "missing"
    assert source.n_opened == 0


@pytest.mark.parametrize(
    "error", [SourceError("told: unplugged"), OSError(19, "No such device"), FlightError("told: x")]
)
def test_gone_and_back(error: Exception, capfd: pytest.CaptureFixture[str]) -> None:
    with running() as run:
        run.more()

        def gone(_: Picture) -> None:
            raise error

        run.source.making = gone
        run.until(lambda: run.feed.health.state == "missing")
        run.source.making = lambda picture: picture
        run.more()
        health = run.feed.health
    assert (health.state, health.n_reopened) == ("running", run.source.n_opened - 1)
    assert run.told() == [camera_feed.GONE, camera_feed.BACK]
    assert str(getattr(error, "strerror", error)) in run.warned[0].detail
    assert "Traceback" not in capfd.readouterr().err


def a_drivers_bug(_: Picture) -> Picture:
    raise ValueError("seen at rtsp://me:secret@camera/")


@pytest.mark.parametrize("where", ["open", "read", "picture", "close"])
def test_a_drivers_own_bug_is_reported_with_its_place(
    where: str, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("JOURNAL_STREAM", raising=False)
    source = ToldSource()
    close = source.close
    with running(source, url="rtsp://me:secret@camera/") as run:
        run.more()

        def fail() -> None:
            close()
            a_drivers_bug(Picture(0, np.zeros((1, 1), np.uint8), np.zeros((1, 1, 3), np.uint8)))

        if where == "read":
            source.making = a_drivers_bug
        elif where == "picture":  # one of which nothing can be made
            source.making = lambda p: Picture(p.monotonic_ns, None, p.rgb)  # type: ignore[arg-type]
        else:
            source.making = lambda _: None  # so that it is closed and opened anew
            setattr(source, "opening" if where == "open" else "close", fail)
        run.until(lambda: run.feed.health.state == "driver fault")
        assert "see the journal" in run.feed.health.detail
        n = source.n_opened
        run.until(lambda: where == "open" or source.n_opened > n + 2)  # it is tried again and again
        source.making, source.opening = lambda picture: picture, lambda: None
        source.close = close  # type: ignore[method-assign]
        run.more()
        assert run.feed.health.state == "running"
    assert run.told().count(camera_feed.DRIVER_FAULT) == 1
    assert camera_feed.GONE not in run.told() and camera_feed.MISSING not in run.told()
    printed = capfd.readouterr().err
    assert printed.count("Traceback") == 1
    assert ("_why_invalid" if where == "picture" else "in a_drivers_bug") in printed
    assert "secret" not in printed and (where == "picture" or "camera.url" in printed)
    assert all(line.startswith("companion: ") for line in printed.splitlines())


def test_a_silent_camera_is_reopened() -> None:
    with running() as run:
        run.more()
        run.source.making = lambda _: None
        run.until(lambda: run.feed.health.state == "silent")
        run.until(lambda: run.source.n_opened > 1)
        run.source.making = lambda picture: picture
        run.more()
    assert run.told() == [camera_feed.SILENT, camera_feed.BACK]


def test_a_frozen_camera_gives_no_frames_and_is_reopened() -> None:
    with running() as run:
        run.more()
        kept: list[Picture] = []

        def same(picture: Picture) -> Picture:
            kept.append(picture)
            return Picture(picture.monotonic_ns, kept[0].grey.copy(), kept[0].rgb.copy())

        run.source.making = same
        run.until(lambda: len(kept) > 3)
        n = len(run.frames)
        run.until(lambda: run.feed.health.state == "frozen")
        run.until(lambda: run.source.n_opened == 2)
        n_kept = len(kept)
        run.until(lambda: len(kept) > n_kept + 5)
        assert len(run.frames) == n
        assert str(run.feed.health.state) == "frozen"  # the new opening has not helped
        assert run.feed.health.n_dropped > 10
        run.source.making = lambda picture: picture
        run.more()
        assert run.feed.health.state == "running"
    assert run.told() == [camera_feed.FROZEN, camera_feed.BACK]


def test_a_lens_cap_is_not_a_frozen_camera() -> None:
    with running() as run:
        run.more()
        dark = np.full((48, 64), 3, np.uint8)
        dark[::7] = 5
        run.source.making = lambda p: Picture(p.monotonic_ns, dark.copy(), np.dstack([dark] * 3))
        run.more_than(1.5 * camera_feed.FROZEN_S)
    assert (run.feed.health.state, run.told()) == ("running", [])


def test_colours_alone_show_that_it_lives() -> None:
    with running() as run:
        flat = np.arange(64 * 48).reshape(48, 64).astype(np.uint8)
        run.source.making = lambda p: Picture(p.monotonic_ns, flat.copy(), p.rgb)
        run.more_than(1.5 * camera_feed.FROZEN_S)
    assert run.told() == []


def test_pictures_of_another_size_are_refused_until_it_is_right_again() -> None:
    with running() as run:
        run.more()
        run.source.making = lambda p: Picture(
            p.monotonic_ns, p.grey[:24, :32].copy(), p.rgb[:24, :32].copy()
        )
        run.until(lambda: run.feed.health.state == "silent")
        n = len(run.frames)
        run.until(lambda: run.source.n_opened == 2)  # which sets the size anew
        assert "32 x 24, wanted are 64 x 48" in run.feed.health.detail
        assert len(run.frames) == n
        run.source.making = lambda picture: picture
        run.more()
    assert run.told() == [camera_feed.WRONG_SIZE, camera_feed.BACK]
    assert {frame.grey.shape for frame in run.frames} == {(48, 64)}


def test_stamps_that_go_back_are_refused() -> None:
    with running() as run:
        run.more()
        n_calls = 0

        def jittered(picture: Picture) -> Picture:
            nonlocal n_calls
            n_calls += 1
            back_ns = 100_000_000 if n_calls % 3 == 0 else 0
            return Picture(picture.monotonic_ns - back_ns, picture.grey, picture.rgb)

        run.source.making = jittered
        run.until(lambda: run.feed.health.n_dropped >= 3)
        assert run.feed.health.state == "running"
    assert np.all(np.diff([frame.t_ns for frame in run.frames]) > 0)
    assert run.told() == [camera_feed.WRONG_STAMP]  # not for each of them


@pytest.mark.parametrize("off_s", [3600, -3600])
def test_stamps_far_from_now_are_refused_and_do_no_lasting_harm(off_s: int) -> None:
    with running() as run:
        run.more()
        run.source.making = lambda p: Picture(p.monotonic_ns + off_s * 1_000_000_000, p.grey, p.rgb)
        run.until(lambda: run.feed.health.n_dropped >= 5)
        n = len(run.frames)
        run.source.making = lambda picture: picture
        run.more()
    assert len(run.frames) > n
    assert run.told()[0] == camera_feed.WRONG_STAMP


def test_remarks_of_a_source_are_reported() -> None:
    with running() as run:
        run.source.remarks.append("told: 15 pictures/s, 30 were asked")
        run.until(lambda: len(run.warned) == 1)
    assert run.warned[0].what == camera_feed.NOT_AS_ASKED
    assert run.source.remarks == []


def test_the_end_is_the_end() -> None:
    with running() as run:
        run.more()

        def ended(_: Picture) -> None:
            raise EndOfPictures("told: all were shown")

        run.source.making = ended
        run.until(lambda: run.feed.health.state == "ended")
        time.sleep(0.1)
    assert run.source.n_opened == 1
    assert run.told() == [camera_feed.ENDED]


def test_a_driver_that_hangs_does_not_hold_up_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera_feed, "STOP_S", 0.1)
    source, release, hung = ToldSource(), threading.Event(), threading.Event()

    def hang(_: Picture) -> None:
        hung.set()
        release.wait(60)

    source.making = hang
    feed = CameraFeed(source, FlightClock(), CameraConfig(), lambda _: None, lambda _: None)
    feed.start()
    assert hung.wait(PATIENCE_S)
    begun_s = time.monotonic()
    feed.stop()
    assert time.monotonic() - begun_s < 20
    release.set()
    feed.stop()
    assert not source.is_open
