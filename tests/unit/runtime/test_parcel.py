"""Messages between processes: what is closed comes out the same, and is freed."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from companion.geometry.transforms import Pose
from companion.messages import Bytes, Frame, MapUpdate, Track, TrackState
from companion.runtime.parcel import INLINE_BYTES, MOST_BYTES, Parcel
from companion.telemetry import (
    ArmedSample,
    AttitudeSample,
    ImuSample,
    PositionSample,
    PositionSource,
    Telemetry,
)

Ends = tuple[socket.socket, socket.socket]


@pytest.fixture
def ends() -> Iterator[Ends]:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        yield ours, theirs


def received(end: socket.socket) -> Parcel:
    """The only parcel of the next packet."""
    (parcel,) = Parcel.receive(end)
    return parcel


def frame(rng: np.random.Generator, width: int = 640, height: int = 480) -> Frame:
    def pixels(*shape: int) -> Bytes:
        return rng.integers(0, 256, shape, dtype=np.uint8)

    return Frame(7, 123_456, pixels(height, width), pixels(height, width, 3))


def n_descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.mark.parametrize("width", [16, 640])
def test_a_frame_crosses_whole(ends: Ends, rng: np.random.Generator, width: int) -> None:
    sent = frame(rng, width)
    Parcel.of(sent).send(ends[0])
    parcel = received(ends[1])
    assert (parcel.kind, parcel.t_ns) == ("Frame", 123_456)
    got = parcel.open()
    assert (got.seq, got.t_ns) == (7, 123_456)
    assert np.array_equal(got.grey, sent.grey) and np.array_equal(got.rgb, sent.rgb)


def test_small_and_large_messages_come_in_their_order(ends: Ends, rng: np.random.Generator) -> None:
    given = [Track(1, 1, TrackState.LOST), frame(rng), Track(2, 2, TrackState.LOST), frame(rng)]
    for message in given:
        Parcel.of(message).send(ends[0])
    got = [received(ends[1]) for _ in given]
    assert [p.kind for p in got] == ["Track", "Frame", "Track", "Frame"]
    assert [p.open().seq for p in got] == [1, 7, 2, 7]


def test_only_a_large_message_is_sent_with_a_descriptor(
    ends: Ends, rng: np.random.Generator
) -> None:
    for message, n in ((frame(rng, 16), 0), (frame(rng), 1)):
        Parcel.of(message).send(ends[0])
        _packet, descriptors, _flags, _address = socket.recv_fds(ends[1], MOST_BYTES, 2)
        for each in descriptors:
            os.close(each)
        assert len(descriptors) == n


@pytest.mark.timeout(20)
def test_nothing_waits_for_room_that_is_told_not_to(ends: Ends, rng: np.random.Generator) -> None:
    small = Parcel.of(Track(1, 1, TrackState.LOST))
    with pytest.raises(BlockingIOError):
        while True:
            small.send(ends[0], socket.MSG_DONTWAIT)
    with pytest.raises(BlockingIOError):
        Parcel.of(frame(rng)).send(ends[0], socket.MSG_DONTWAIT)


def test_small_messages_cross_together_in_one_packet(ends: Ends, rng: np.random.Generator) -> None:
    small = [Track(n, 10 * n, TrackState.LOST) for n in range(3)]
    Parcel.send_together([Parcel.of(each) for each in small], ends[0])
    Parcel.send_together([Parcel.of(frame(rng))], ends[0])
    got = Parcel.receive(ends[1])
    assert [(parcel.kind, parcel.t_ns) for parcel in got] == [("Track", 10 * n) for n in range(3)]
    assert [parcel.open().seq for parcel in got] == [0, 1, 2]
    assert received(ends[1]).open().seq == 7


def test_as_many_small_messages_as_may_go_together_fit_into_a_packet(ends: Ends) -> None:
    parcel = Parcel.of(None)  # there is no smaller one
    Parcel.send_together([parcel] * (INLINE_BYTES // parcel.n_bytes), ends[0])
    assert len(Parcel.receive(ends[1])) == INLINE_BYTES // parcel.n_bytes


def test_a_map_of_many_small_arrays_crosses_whole(ends: Ends) -> None:
    poses = {n: Pose(np.eye(3), np.array([n, 0.5, -1.0])) for n in range(2000)}
    parcel = Parcel.of(MapUpdate(3, 4, poses, np.ones((5000, 3)), None))
    assert parcel.n_bytes > INLINE_BYTES
    parcel.send(ends[0])
    got = received(ends[1]).open()
    assert got.map_from_camera[1999].translation.tolist() == [1999, 0.5, -1.0]
    assert got.points_map.shape == (5000, 3)


def test_arrays_in_another_order_of_memory_cross_whole(rng: np.random.Generator) -> None:
    whole = rng.random((300, 400))
    for array in (whole.T, whole[::2, ::3], np.asfortranarray(whole), whole[:0]):
        assert np.array_equal(Parcel.of(array).open(), array)


def test_arrays_of_any_kind_cross_whole_and_may_be_written_to() -> None:
    arrays = [
        np.array([1.0, np.nan]), np.array(3.5), np.zeros((0, 3)), np.eye(3, dtype=np.float32).T,
        np.array([[True], [False]]), np.array(["a", "bc"]), np.array([1], ">i4"),
        np.array([1, None], object), np.arange(3, dtype=np.uint16), np.ones((2, 3), order="F"),
    ]  # fmt: skip
    for array, got in zip(arrays, Parcel.of(arrays).open(), strict=True):
        assert (got.dtype, got.shape) == (array.dtype, array.shape)
        assert got.tolist() == array.tolist() or np.isnan(array[1])
        got[...] = got.copy()


def test_samples_of_telemetry_cross_whole() -> None:
    samples: list[Telemetry] = [
        AttitudeSample(1, np.array([1.0, 0, 0, 0]), None),
        ImuSample(2, np.array([0.1, 0.2, 0.3]), np.array([0.0, 0.0, -9.8])),
        PositionSample(3, PositionSource.GPS, np.zeros(3), np.ones(3), 0.5),
        ArmedSample(4, True),
    ]
    for sample in samples:
        got = Parcel.of(sample).open()
        assert type(got) is type(sample)
        for each in fields(sample):
            assert np.array_equal(getattr(got, each.name), getattr(sample, each.name)), each.name


def test_what_one_reader_writes_no_other_sees(rng: np.random.Generator) -> None:
    parcel = Parcel.of(frame(rng))
    first = parcel.open()
    before = first.grey.copy()
    first.grey[:] = 0
    assert np.array_equal(parcel.open().grey, before)


def test_memory_is_freed_with_its_last_reader(ends: Ends, rng: np.random.Generator) -> None:
    before = n_descriptors()
    for _ in range(50):
        Parcel.of(frame(rng)).send(ends[0])
        got = received(ends[1]).open()
    assert n_descriptors() <= before + 2
    del got
    assert n_descriptors() == before


def test_an_array_outlives_its_parcel(rng: np.random.Generator) -> None:
    sent = frame(rng)
    grey = Parcel.of(sent).open().grey
    assert np.array_equal(grey, sent.grey)


def test_the_end_of_the_sender_is_told(ends: Ends) -> None:
    Parcel.of(Track(1, 1, TrackState.LOST)).send(ends[0])
    ends[0].close()
    assert received(ends[1]).kind == "Track"
    with pytest.raises(EOFError):
        Parcel.receive(ends[1])


def test_last_words_come_also_from_one_that_left_something_unread(ends: Ends) -> None:
    """A stage that cannot begin says why, and ends with messages waiting for it."""
    Parcel.of(Track(1, 1, TrackState.LOST)).send(ends[0])
    Parcel.of(Track(2, 2, TrackState.LOST)).send(ends[1])
    ends[1].close()
    assert received(ends[0]).open().seq == 2
    with pytest.raises(EOFError):
        Parcel.receive(ends[0])


def test_a_reader_that_is_gone_is_an_error(ends: Ends, rng: np.random.Generator) -> None:
    ends[1].close()
    before = n_descriptors()
    with pytest.raises(OSError):
        Parcel.of(frame(rng)).send(ends[0])
    assert n_descriptors() == before
