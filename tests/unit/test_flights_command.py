import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.cli import main
from companion.config import CameraConfig
from companion.messages import Frame
from drivers.open_flight import open_flight
from drivers.recording.recorded_flight import RecordedFlight
from tests.support.recorded import STEP_NS, record

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
