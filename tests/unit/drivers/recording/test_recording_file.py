import errno
import os
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from companion.errors import FlightError
from drivers.recording.growing_file import GrowingFile, is_growing
from drivers.recording.mcap_file import McapFile
from drivers.recording.mcap_scan import Scan, scan, summary
from drivers.recording.mcap_writer import MAGIC, McapWriter
from drivers.recording.repair import n_cut_bytes, opened

N_CHUNKS, PER_CHUNK = 6, 3
Told = list[tuple[str, int, int, bytes]]


def content(number: int) -> bytes:
    return np.random.default_rng(number).bytes(60) + b"0" * 20


def write(path: Path) -> list[int]:
    """A small recording; where each of its chunks ends."""
    file = GrowingFile(path)
    writer = McapWriter(file.append, "companion")
    schema = writer.schema("some.Thing", "jsonschema", b"{}")
    channels = [writer.channel(f"/{name}", "json", schema) for name in "ab"]
    writer.attach("camera.json", "application/json", b'{"fx": 1}', 7)
    writer.note("companion", {"version": "1"})
    ends = []
    for number in range(N_CHUNKS * PER_CHUNK):
        writer.add(channels[number % 2], 1000 + number, content(number), 2000 + number)
        if number % PER_CHUNK == PER_CHUNK - 1:
            writer.flush()
            ends.append(writer.n_bytes)
    writer.finish()
    file.close()
    return ends


def read(file: McapFile, found: Scan) -> Told:
    return [
        (message.channel.topic, message.sequence, message.t_ns, bytes(message.data))
        for chunk in found.chunks
        for message in file.messages(chunk, dict(found.contents.channels))
    ]


@pytest.fixture
def whole(tmp_path: Path) -> tuple[Path, list[int]]:
    path = tmp_path / "flight.mcap"
    return path, write(path)


def test_what_is_written_is_read_and_others_read_it_too(whole: tuple[Path, list[int]]) -> None:
    path, _ = whole
    with McapFile(path) as file:
        found, by_end = scan(file), summary(file)
        told = read(file, found)
    assert by_end is not None and by_end.contents == found.contents
    assert found.whole and found.profile == by_end.profile == "companion"
    assert (found.n_lost_bytes, found.n_cut_bytes) == (0, 0)
    assert found.attachments == {"camera.json": b'{"fx": 1}'}
    assert found.metadata == {"companion": {"version": "1"}}
    assert told == [
        (f"/{'ab'[n % 2]}", n // 2, 1000 + n, content(n)) for n in range(N_CHUNKS * PER_CHUNK)
    ]
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        theirs = [(c.topic, m.sequence, m.log_time, m.data) for _, c, m in reader.iter_messages()]
        assert theirs == told
        assert [each.name for each in reader.iter_attachments()] == ["camera.json"]


def test_cut_anywhere_it_keeps_all_chunks_before_and_is_repaired(
    whole: tuple[Path, list[int]], tmp_path: Path
) -> None:
    path, ends = whole
    data = path.read_bytes()
    cut = tmp_path / "cut.mcap"
    steps = sorted({*range(len(MAGIC), len(data), 43), *ends, *(end - 1 for end in ends)})
    for size in steps:
        cut.write_bytes(data[:size])
        file, found = opened(cut)
        with file:
            n_whole = len(found.chunks)
            told = read(file, found)
            by_end = summary(file)
        assert n_whole >= sum(end <= size for end in ends), size
        assert told == [
            (f"/{'ab'[n % 2]}", n // 2, 1000 + n, content(n)) for n in range(n_whole * PER_CHUNK)
        ]
        assert found.whole and by_end is not None
        assert n_cut_bytes(found) < 700
        with cut.open("rb") as stream:
            assert len(list(make_reader(stream).iter_messages())) == len(told)


def test_what_a_repair_cut_off_is_still_known_later(
    whole: tuple[Path, list[int]], tmp_path: Path
) -> None:
    path, ends = whole
    path.write_bytes(path.read_bytes()[: ends[2] + 100])
    first = opened(path)
    first[0].close()
    second = opened(path)
    second[0].close()
    assert n_cut_bytes(first[1]) == n_cut_bytes(second[1]) == 100
    assert second[1].n_lost_bytes == 0


def test_damage_costs_the_chunk_that_it_hits_and_never_more_than_time(
    whole: tuple[Path, list[int]], tmp_path: Path
) -> None:
    path, _ = whole
    data = path.read_bytes()
    damaged = tmp_path / "damaged.mcap"
    expected = {f"/{'ab'[n % 2]}:{1000 + n}": content(n) for n in range(N_CHUNKS * PER_CHUNK)}
    for seed in range(120):
        rng = np.random.default_rng(seed)
        changed = np.frombuffer(data, np.uint8).copy()
        at = int(rng.integers(len(MAGIC), len(data)))
        if seed % 3 == 0:
            changed[at] ^= 1 << int(rng.integers(8))
        elif seed % 3 == 1:
            changed[at : at + 50] = 0
        else:
            changed[at : at + 50] = rng.integers(0, 256, len(changed[at : at + 50]))
        damaged.write_bytes(changed.tobytes())
        file, _ = opened(damaged)
        with file:
            found = scan(file)
            told = read(file, found)
        for topic, _, t_ns, held in told:
            assert expected[f"{topic}:{t_ns}"] == held, seed
        assert len(told) >= (N_CHUNKS - 2) * PER_CHUNK, seed


def test_damage_is_counted(whole: tuple[Path, list[int]]) -> None:
    path, ends = whole
    data = bytearray(path.read_bytes())
    data[ends[2] + 100] ^= 1
    path.write_bytes(data)
    with McapFile(path) as file:
        found = scan(file)
    assert len(found.chunks) == N_CHUNKS - 1
    assert found.n_lost_places == 1
    assert ends[3] - ends[2] == found.n_lost_bytes


def test_what_is_no_mcap_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"hello")
    for name in ("a.mcap", "missing.mcap"):
        with pytest.raises(FlightError, match=name):
            McapFile(tmp_path / name)


def test_a_file_that_grows_is_read_and_left_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    file = GrowingFile(path)
    writer = McapWriter(file.append, "companion")
    channel = writer.channel("/a", "json", 0)
    writer.add(channel, 5, b"{}", 5)
    writer.flush()
    before = path.read_bytes()
    reading, found = opened(path)
    with reading:
        assert len(read(reading, found)) == 1
    assert path.read_bytes() == before
    with path.open("rb") as stream:
        assert is_growing(stream.fileno())
        file.close()
        assert not is_growing(stream.fileno())


def test_a_write_that_fails_leaves_nothing_of_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "flight.mcap"
    file = GrowingFile(path)
    writer = McapWriter(file.append, "companion")
    channel = writer.channel("/a", "json", 0)
    size = path.stat().st_size
    really = os.write

    def fills_up(fd: int, data: bytes) -> int:
        if len(data) < 60:
            raise OSError(errno.ENOSPC, "No space left on device")
        return really(fd, bytes(data)[: len(data) // 2])

    writer.add(channel, 5, np.random.default_rng(1).bytes(500), 5)
    with monkeypatch.context() as patched:
        patched.setattr(os, "write", fills_up)
        with pytest.raises(OSError, match="No space"):
            writer.flush()
    assert path.stat().st_size == size
    writer.finish()
    file.close()
    with McapFile(path) as again:
        found = scan(again)
    assert found.whole and found.contents.counts == {channel: 1}
