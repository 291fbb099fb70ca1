"""Frame ring between processes: frames whole, or reported as overwritten."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from companion.messages import Frame
from companion.runtime.frame_ring import FrameHandle, FrameRing

ROOT = Path(__file__).parents[3]
WIDTH, HEIGHT = 640, 480
READER = """
import pickle, sys
from companion.runtime.frame_ring import FrameRing
fd, width, height, stops = map(int, sys.argv[1:])
ring = FrameRing(width, height, fd)
copy = FrameRing._copy
def slowly(self, place, colour):
    grey = copy(self, place, False).grey
    if stops:
        print("reading", flush=True)
        sys.stdin.readline()
    frame = copy(self, place, colour)  # what is there now: not as it was, if somebody wrote
    frame.grey[: height // 2] = grey[: height // 2]
    return frame
FrameRing._copy = slowly
while (line := sys.stdin.readline()).strip():
    from companion.runtime.frame_ring import FrameHandle
    seq, serial = map(int, line.split())
    frame = ring.get(FrameHandle(seq, 0, serial))
    if frame is None:
        print("late", flush=True)
    else:
        values = {int(v) for part in (frame.grey, frame.rgb) for v in (part.min(), part.max())}
        print(*sorted(values), flush=True)
"""


class Reader:
    """A process that reads frames when asked."""

    def __init__(self, ring: FrameRing, stops: bool) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", READER, *map(str, (ring.fd, WIDTH, HEIGHT, int(stops)))],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=(ring.fd,), text=True, cwd=ROOT,
        )  # fmt: skip

    def ask(self, place: FrameHandle) -> None:
        self.say(f"{place.seq} {place.serial}")

    def say(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def answer(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()


@pytest.fixture
def ring() -> Iterator[FrameRing]:
    made = FrameRing(WIDTH, HEIGHT)
    yield made
    made.close()


def frame(seq: int) -> Frame:
    """All of one value, by which a torn one is known."""
    value = np.uint8(seq % 251)
    return Frame(
        seq, seq, np.full((HEIGHT, WIDTH), value), np.full((HEIGHT, WIDTH, 3), value)
    )  # fmt: skip


def test_a_frame_that_is_being_read_is_not_written_over(ring: FrameRing) -> None:
    """The reader stops in the middle of its copy, and the writer goes round twice."""
    reader = Reader(ring, stops=True)
    with reader.process:
        place = ring.put(frame(7))
        reader.ask(place)
        assert reader.answer() == "reading"
        places = [ring.put(frame(seq)) for seq in range(8, 8 + 2 * ring.n_slots)]
        assert len({p.serial for p in places}) == len(places)
        assert place.serial % ring.n_slots not in {p.serial % ring.n_slots for p in places}
        reader.say("go on")
        assert reader.answer() == "7"
        # the slot is free again, and what was in it is known to be gone
        for seq in range(200, 200 + ring.n_slots):
            ring.put(frame(seq))
        reader.ask(place)
        assert reader.answer() == "late"
        reader.say("")


def test_a_reader_that_dies_holds_nothing(ring: FrameRing) -> None:
    reader = Reader(ring, stops=True)
    with reader.process:
        place = ring.put(frame(7))
        reader.ask(place)
        assert reader.answer() == "reading"
        reader.process.kill()
        reader.process.wait()
        places = [ring.put(frame(seq)) for seq in range(8, 8 + ring.n_slots)]
        assert place.serial % ring.n_slots in {p.serial % ring.n_slots for p in places}


def test_no_torn_frame_where_reader_and_writer_race(ring: FrameRing) -> None:
    """Frames are written without a pause, and the oldest is read, which is the next to go."""
    reader = Reader(ring, stops=False)
    with reader.process:
        places = [ring.put(frame(seq)) for seq in range(ring.n_slots)]
        seq, n_whole, n_late = ring.n_slots, 0, 0
        until_s = time.monotonic() + 3.0
        while time.monotonic() < until_s or not (n_whole and n_late):
            asked = places[-ring.n_slots + (n_whole + n_late) % 3]
            reader.ask(asked)
            for _ in range(3):
                places = [*places[-ring.n_slots :], ring.put(frame(seq))]
                seq += 1
            answer = reader.answer()
            if answer == "late":
                n_late += 1
            else:
                assert answer == str(asked.seq % 251)
                n_whole += 1
            assert time.monotonic() < until_s + 60, (n_whole, n_late)
        reader.say("")


def test_a_frame_of_another_size_leaves_nothing_torn(ring: FrameRing) -> None:
    other = Frame(1, 1, np.zeros((HEIGHT, WIDTH), np.uint8), np.zeros((4, 4, 3), np.uint8))
    places = [ring.put(frame(seq)) for seq in range(ring.n_slots)]
    with pytest.raises(ValueError, match="broadcast"):
        ring.put(other)
    assert ring.get(places[0]) is None
    found = ring.get(places[1])
    assert found is not None
    assert int(found.rgb.max()) == 1
