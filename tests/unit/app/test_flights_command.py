import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from companion.app.cli import main
from companion.config import CameraConfig
from companion.messages import Frame
from companion.telemetry import ArmedSample
from drivers.open_flight import open_flight
from drivers.recording import trimming
from drivers.recording.importing import write_recording
from drivers.recording.recording_as_flight import RecordedFlight
from tests.support.flights.recorded import STEP_NS, record

FIRST, SECOND = "2026-01-01T00-00-00Z", "2026-01-02T00-00-00Z"


@pytest.fixture
def flights(tmp_path: Path) -> Path:
    record(tmp_path / FIRST, 10)
    record(tmp_path / SECOND, 40, "h264")
    return tmp_path


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    status = main(["flights", *map(str, words)])
    out, err = capsys.readouterr()
    return status, out, err


def frames_of(path: Path, start_ns: int | None = None) -> list[Frame]:
    flight = open_flight(path, CameraConfig())
    return [frame for frame in flight.frames(start_ns) if isinstance(frame, Frame)]


def test_list_and_show(flights: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = run(capsys, "list", "--flights", flights, "--json")
    rows: list[dict[str, Any]] = json.loads(out)
    assert status == 0
    assert [(r["flight"], r["pictures"], r["state"]) for r in rows] == [
        (FIRST, 10, "whole"), (SECOND, 40, "whole"),
    ]  # fmt: skip
    _, out, _ = run(capsys, "list", "--flights", flights)
    assert FIRST in out and "2 recordings" in out
    _, out, _ = run(capsys, "show", FIRST, "--flights", flights, "--json")
    shown = json.loads(out)
    assert shown["topics"]["/camera/image"] == 10
    assert shown["attachments"] == ["camera.json", "config.toml"]
    _, out, _ = run(capsys, "show", flights / SECOND / "flight.mcap")
    assert "/camera/video" in out


def test_verify_finds_damage_and_changes_nothing(
    flights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(capsys, "verify", "--flights", flights)[0] == 0
    path = flights / FIRST / "flight.mcap"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)
    status, out, _ = run(capsys, "verify", "--flights", flights)
    assert status == 1 and "damaged" in out and "whole" in out
    path.write_bytes(data[:-500])
    status, out, _ = run(capsys, "verify", FIRST, "--flights", flights)
    assert status == 1 and "cut short" in out
    assert path.read_bytes() == data[:-500]


def test_a_part_has_the_same_pictures_and_samples(
    flights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = flights / "part.mcap"
    path = flights / SECOND / "flight.mcap"
    start_s = 34 * STEP_NS * 1e-9
    assert run(capsys, "trim", path, "--start", start_s, "--stop", 1.2, "--out", out)[0] == 0
    whole, part = frames_of(path), frames_of(out)
    assert [f.seq for f in part] == list(range(35, 42))  # from the picture that stands alone
    by_seq = {f.seq: f for f in whole}
    assert all(np.array_equal(f.rgb, by_seq[f.seq].rgb) for f in part)
    assert len(open_flight(out, CameraConfig()).telemetry().samples) > 100
    with out.open("rb") as file:
        times_ns = [m.log_time for _, _, m in make_reader(file).iter_messages(["/odometry"])]
    assert times_ns
    assert min(times_ns) >= part[0].t_ns, "a pose of a picture that is not in it"
    status, _, err = run(capsys, "trim", path, "--start", 1, "--out", out)
    assert status == 2 and "File exists" in err
    status, _, err = run(capsys, "trim", path, "--start", 100, "--out", flights / "no.mcap")
    assert status == 2 and "no picture" in err


@pytest.mark.parametrize("codec", ["mjpeg", "h264", "raw"])
def test_an_exported_flight_is_the_same_flight(
    tmp_path: Path, codec: str, capsys: pytest.CaptureFixture[str]
) -> None:
    record(tmp_path / "f", 40, codec)
    assert run(capsys, "export", tmp_path / "f", "--out", tmp_path / "out")[0] == 0
    ours, theirs = (open_flight(tmp_path / name, CameraConfig()) for name in ("f", "out"))
    assert isinstance(ours, RecordedFlight) and not isinstance(theirs, RecordedFlight)
    assert theirs.times_ns == ours.times_ns
    assert (theirs.camera.fx, theirs.camera.coefficients) == (
        ours.camera.fx, ours.camera.coefficients,
    )  # fmt: skip
    for a, b in zip(frames_of(tmp_path / "f"), frames_of(tmp_path / "out"), strict=True):
        assert np.array_equal(a.rgb, b.rgb)
    assert run(capsys, "export", tmp_path / "f", "--out", tmp_path / "out")[0] == 2


@pytest.fixture
def imported(tmp_path: Path) -> Path:
    """A recording that was imported: no bytes of a link, one health document, one armed sample."""
    record(tmp_path / "flown", 40)
    source = open_flight(tmp_path / "flown", CameraConfig())
    log = source.telemetry()
    armed = [sample for sample in log.samples if isinstance(sample, ArmedSample)]
    samples = [s for s in log.samples if not isinstance(s, ArmedSample) or s is armed[0]]
    source._telemetry = dataclasses.replace(log, samples=samples)
    write_recording(source, tmp_path / "a.mcap", lambda n: None)
    return tmp_path / "a.mcap"


def test_an_exported_import_has_its_telemetry(
    imported: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = imported.parent / "out"
    assert run(capsys, "export", imported, "--out", out)[0] == 0
    assert not (out / "flight.tlog").exists()
    ours, theirs = (open_flight(path, CameraConfig()).telemetry() for path in (imported, out))
    assert len(theirs.samples) == len(ours.samples) > 100
    assert theirs.origin == ours.origin is not None
    assert repr(theirs.clock) == repr(ours.clock) != "None"


def test_a_part_far_from_the_begin_has_what_was_said_at_the_begin_only(
    imported: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Place on Earth, clock, and that the motors are armed."""
    monkeypatch.setattr(trimming, "LEAD_NS", 3 * STEP_NS)
    out = imported.parent / "part.mcap"
    assert run(capsys, "trim", imported, "--start", 1, "--out", out)[0] == 0
    whole, part = (open_flight(path, CameraConfig()) for path in (imported, out))
    assert part.telemetry().origin == whole.telemetry().origin is not None
    assert repr(part.telemetry().clock) == repr(whole.telemetry().clock) != "None"
    samples = part.telemetry().samples
    assert [s.armed for s in samples if isinstance(s, ArmedSample)] == [True]
    assert isinstance(samples[0], ArmedSample)
    assert samples[0].t_ns == part.start_ns - 3 * STEP_NS
    assert len(samples) < len(whole.telemetry().samples) / 2


@pytest.mark.parametrize(
    "words", [["--keep-newest", -1], ["--older-than", -3], ["--older-than", "nan"], ["--free", -1]]
)
def test_prune_takes_no_number_below_zero(
    flights: Path, capsys: pytest.CaptureFixture[str], words: list[object]
) -> None:
    with pytest.raises(SystemExit):
        run(capsys, "prune", "--flights", flights, *words)
    assert "wanted a number from 0 on" in capsys.readouterr().err
    assert (flights / FIRST).exists() and (flights / SECOND).exists()


def test_prune_deletes_the_oldest_only(flights: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(capsys, "prune", "--flights", flights)[0] == 2
    run(capsys, "prune", "--flights", flights, "--keep-newest", 1, "--dry-run")
    assert (flights / FIRST).exists()
    (flights / FIRST / "keep").touch()
    run(capsys, "prune", "--flights", flights, "--keep-newest", 1)
    assert (flights / FIRST).exists()
    (flights / FIRST / "keep").unlink()
    run(capsys, "prune", "--flights", flights, "--older-than", 1e6)
    assert (flights / FIRST).exists()
    status, out, _ = run(capsys, "prune", "--flights", flights, "--keep-newest", 1)
    assert status == 0 and "1 of 2 flights" in out
    assert not (flights / FIRST).exists() and (flights / SECOND).exists()


def test_what_is_not_there_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (["list"], ["show", "x"], ["trim", "x", "--out", "y"], ["verify", "x"]):
        status, _, err = run(capsys, *words, "--flights", tmp_path / "none")
        assert status == 2 and "none" in err
