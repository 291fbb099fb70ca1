import errno
import os
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from companion.config import CameraConfig, Config, RecorderConfig, TelemetryConfig
from companion.errors import FlightError, StageError
from companion.flight_notes import LinkBytes
from companion.messages import Frame, Warned
from drivers.recording import disk_writer
from drivers.recording.disk_writer import CHUNK_BYTES, FULL, PRUNED, RESERVE_BYTES, SLOW, DiskWriter
from drivers.recording.flights_folder import UNARMED, flights_in, flown_in, may_go
from drivers.recording.mcap_writer import McapWriter
from drivers.recording.recorder import Recorder
from drivers.recording.recording_as_flight import RecordedFlight, open_recording
from tests.support.flights.recorded import SIZE, START_NS, STEP_NS, camera, record

DISK_MB = 12
PICTURE_BYTES = 4 * SIZE[0] * SIZE[1]
"""In colours and grey."""
LEAST_WRITTEN = ((DISK_MB << 20) - RESERVE_BYTES - CHUNK_BYTES) // PICTURE_BYTES - 2
"""Pictures on a disk that was full when a chunk was to be written: all but those of the chunk."""


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk that is soon full."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "tmpfs", str(place)]
    if subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("may not mount a file system")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def noise(seq: int) -> Frame:
    rgb = np.random.default_rng(seq).integers(0, 256, (SIZE[1], SIZE[0], 3), np.uint8)
    return Frame(seq, START_NS + seq * STEP_NS, rgb[:, :, 0], rgb)


def fly(recorder: Recorder, n: int, every_s: float = 0.0) -> list[Warned]:
    told = []
    for seq in range(n):
        recorder.take(noise(seq))
        t_ns = START_NS + seq * STEP_NS + 1
        recorder.take(LinkBytes(t_ns, t_ns, False, b"x"))
        time.sleep(every_s)
        told += recorder.warnings()
    recorder.close()
    return told + recorder.warnings()


def recorder_in(folder: Path, **changes: object) -> Recorder:
    folder.mkdir(parents=True)
    values: dict[str, object] = {"codec": "raw", "flush_s": 0.1, "least_free_mb": 1, **changes}
    config = Config(recorder=RecorderConfig(**values))  # type: ignore[arg-type]
    return Recorder(folder, config, camera(), {})


def opened(folder: Path) -> RecordedFlight:
    return open_recording(folder / "flight.mcap", CameraConfig(), TelemetryConfig())


def old_flight(place: Path, name: str, megabytes: int) -> Path:
    folder = place / name
    record(folder, 3)
    (folder / "cloud.ply").write_bytes(b"\0" * (megabytes << 20))
    return folder


def test_on_a_full_disk_recording_ends_with_a_warning_and_what_there_is_is_whole(
    small_disk: Path,
) -> None:
    recorder = recorder_in(small_disk / "2026-01-01T00-00-00Z", when_full="stop")
    told = fly(recorder, 250, 0.002)  # 19 MB
    assert [w.what for w in told] == [FULL]
    assert recorder.n_dropped["pictures"] > 0
    flight = opened(small_disk / "2026-01-01T00-00-00Z")
    assert flight.warnings == () and flight.n_frames >= LEAST_WRITTEN - (1 << 20) // PICTURE_BYTES
    n_read = sum(isinstance(frame, Frame) for frame in flight.frames())
    assert n_read == flight.n_frames


def test_a_disk_that_fills_up_between_two_looks_is_no_different(small_disk: Path) -> None:
    recorder = recorder_in(small_disk / "2026-01-01T00-00-00Z", when_full="stop", least_free_mb=0)
    told = fly(recorder, 250, 0.001)
    assert [w.what for w in told] == [FULL]
    assert opened(small_disk / "2026-01-01T00-00-00Z").n_frames >= LEAST_WRITTEN


def test_the_oldest_flights_make_room_but_not_those_to_be_kept(small_disk: Path) -> None:
    kept = old_flight(small_disk, "2025-01-01T00-00-00Z", 2)
    (kept / "keep").touch()
    oldest = old_flight(small_disk, "2025-01-02T00-00-00Z", 2)
    older = old_flight(small_disk, "2025-01-02T00-00-00Z-2", 2)
    foreign = old_flight(small_disk, "holiday", 1)
    recorder = recorder_in(small_disk / "2026-01-01T00-00-00Z", when_full="prune")
    told = fly(recorder, 75, 0.002)  # 5.6 MB
    assert [w.what for w in told] == [PRUNED, PRUNED][: len(told)] and told
    assert told[0].detail.startswith(oldest.name)
    assert not oldest.exists() and kept.exists() and foreign.exists()
    assert older.exists() == (len(told) == 1)
    assert opened(small_disk / "2026-01-01T00-00-00Z").n_frames == 75


def test_on_a_full_disk_flights_that_cannot_be_listed_are_not_pruned(
    small_disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unreadable(_: Path) -> list[object]:
        raise FlightError("cannot be read")

    monkeypatch.setattr(disk_writer, "flights_in", unreadable)
    recorder = recorder_in(small_disk / "2026-01-01T00-00-00Z", when_full="prune", least_free_mb=0)
    assert [warned.what for warned in fly(recorder, 250, 0.001)] == [FULL]


def test_a_fault_of_the_last_write_is_told_by_close(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = recorder_in(tmp_path / "flight")

    def wrong(_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(McapWriter, "finish", wrong)
    with pytest.raises(ZeroDivisionError):
        recorder.close()


def test_where_no_space_can_be_reserved_the_recording_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: Path) -> None:
        raise OSError(errno.EDQUOT, "Disk quota exceeded")

    monkeypatch.setattr(disk_writer, "_reserved", full)
    with pytest.raises(StageError, match="Disk quota exceeded"):
        recorder_in(tmp_path / "flight")
    assert list((tmp_path / "flight").iterdir()) == []


@pytest.mark.real_time
def test_a_slow_disk_makes_nobody_wait_and_costs_pictures_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    really = os.fdatasync

    def slow(fd: int) -> None:
        time.sleep(0.4)
        really(fd)

    monkeypatch.setattr(os, "fdatasync", slow)
    recorder = recorder_in(tmp_path / "2026-01-01T00-00-00Z", buffer_mb=4, least_free_mb=0)
    longest_s = 0.0
    for seq in range(150):  # 11 MB in less than a second
        began_s = time.perf_counter()
        recorder.take(noise(seq))
        t_ns = START_NS + seq * STEP_NS + 1
        recorder.take(LinkBytes(t_ns, t_ns, False, b"x"))
        longest_s = max(longest_s, time.perf_counter() - began_s)
    recorder.close()
    assert longest_s < 0.3
    assert [w.what for w in recorder.warnings()] == [SLOW]
    assert recorder.n_dropped["pictures"] > 10 and recorder.n_dropped["messages"] == 0
    flight = opened(tmp_path / "2026-01-01T00-00-00Z")
    assert flight.n_frames == 150 - recorder.n_dropped["pictures"]
    assert flight.recording.counts["/mavlink/received"] == 150


def test_small_messages_do_not_wake_the_thread_that_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[int] = []
    has_enough = DiskWriter._has_enough

    def looked(writer: DiskWriter) -> bool:
        if threading.current_thread() is writer._thread:
            looks.append(len(looks))
        return has_enough(writer)

    monkeypatch.setattr(DiskWriter, "_has_enough", looked)
    recorder = recorder_in(tmp_path / "2026-01-01T00-00-00Z", flush_s=60.0)
    assert fly(recorder, 30, 0.002) == []
    assert len(looks) < 10
    assert opened(tmp_path / "2026-01-01T00-00-00Z").n_frames == 30


def test_what_was_never_armed_goes_first(tmp_path: Path) -> None:
    old = old_flight(tmp_path, "00001-2026-01-01T00-00-00Z", 1)
    (old_flight(tmp_path, "00002-2026-01-02T00-00-00Z", 1) / UNARMED).touch()
    flights = flights_in(tmp_path)
    assert [f.unarmed for f in may_go(flights)] == [True, False]
    assert [f.path for f in flown_in(tmp_path)] == [old]


def test_what_is_recorded_now_is_never_deleted(tmp_path: Path) -> None:
    recorder = recorder_in(tmp_path / "2025-01-01T00-00-00Z")
    record(tmp_path / "2025-02-01T00-00-00Z", 3)
    flights = flights_in(tmp_path)
    assert [f.growing for f in flights] == [True, False]
    assert [f.path.name for f in may_go(flights)] == ["2025-02-01T00-00-00Z"]
    recorder.close()


def test_a_bug_in_the_thread_that_writes_is_not_kept_secret(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(fd: int) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(os, "fdatasync", broken)
    recorder = recorder_in(tmp_path / "f")
    with pytest.raises(ZeroDivisionError):
        fly(recorder, 100, 0.01)
