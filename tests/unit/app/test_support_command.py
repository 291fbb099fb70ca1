"""The bundle for a maintainer: what is in it, and what must not be."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest

from companion.app.cli import main
from companion.config import CameraConfig
from drivers.open_flight import open_flight
from tests.support.flights.recorded import STEP_NS, record

PASSWORD = "sesame-7f3a"
KEY = "00112233445566778899aabbccddeeff" * 2


@pytest.fixture
def config(tmp_path: Path) -> Path:
    key = tmp_path / "key.hex"
    key.write_text(KEY)
    kept = tmp_path / "kept.toml"
    kept.write_text("stream.max_kbit_s = 400\n")
    path = tmp_path / "companion.toml"
    path.write_text(f"""
[camera]
device = "rtsp://pilot:{PASSWORD}@192.168.1.9/stream"
[link]
signing_key_file = "{key}"
[control]
keep = "{kept}"
[daemon]
socket = "{tmp_path / "nobody"}"
""")
    return path


def packed(out: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(out) as bundle:
        assert bundle.testzip() is None
        return {name: bundle.read(name) for name in bundle.namelist()}


def test_all_is_packed_and_told(
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flights, out = tmp_path / "flights", tmp_path / "support.zip"
    flights.mkdir()
    record(flights / "2026-01-01T00-00-00Z", 10)
    record(flights / "2026-01-02T00-00-00Z", 40)
    seconds = 20 * STEP_NS * 1e-9
    words = ["support", "--config", config, "--flights", flights, "--out", out]
    assert main([*map(str, words), "--seconds", str(seconds)]) == 0
    told = capsys.readouterr().out
    files = packed(out)
    assert {"versions.txt", "settings.json", "kept_parameters.toml", "flights.txt"} <= set(files)
    # what it shows is said, and so is what could not be had, with the reason
    assert "PICTURES of the camera, and where on Earth it flew" in told
    assert "status.json: not there: " in told
    assert files["README.txt"].decode().rstrip() in told
    for name in files:
        assert name in told or name == "README.txt"
    assert "parameters.txt: not there: " in told  # link.url names no autopilot
    assert b"numpy " in files["versions.txt"]
    assert b"max_kbit_s = 400" in files["kept_parameters.toml"]
    assert b"2026-01-02T00-00-00Z" in files["flights.txt"]
    # the last pictures of the newest recording, as a recording
    (tmp_path / "newest.mcap").write_bytes(files["newest.mcap"])
    piece = open_flight(tmp_path / "newest.mcap", CameraConfig())
    assert 19 <= piece.n_frames <= 22
    # no secret is anywhere in it
    for name, data in files.items():
        assert PASSWORD.encode() not in data, name
        assert KEY[:16].encode() not in data, name
    assert "***@192.168.1.9" in json.loads(files["settings.json"])["camera"]["device"]


def test_pictures_stay_at_home(
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flights, out = tmp_path / "flights", tmp_path / "support.zip"
    flights.mkdir()
    words = ["support", "--config", config, "--flights", flights, "--out", out, "--seconds", 0]
    assert main([*map(str, words)]) == 0
    assert "newest.mcap: not there: no recording in" in capsys.readouterr().out
    record(flights / "2026-01-01T00-00-00Z", 10)
    assert main([*map(str, words)]) == 0
    assert "newest.mcap: not there: --seconds 0" in capsys.readouterr().out
    assert "newest.mcap" not in packed(out)
    assert "newest.txt" in packed(out)


def test_where_it_cannot_be_written(config: Path, tmp_path: Path) -> None:
    flights = tmp_path / "flights"
    flights.mkdir()
    (tmp_path / "file").write_text("")
    words = ["support", "--config", config, "--flights", flights, "--out", tmp_path / "file" / "a"]
    assert main([*map(str, words)]) == 2


def test_a_drone_that_never_flew_is_helped_too(
    config: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flights, out = tmp_path / "none", tmp_path / "support.zip"
    words = ["support", "--config", config, "--flights", flights, "--out", out]
    assert main([*map(str, words)]) == 0
    assert f"newest.mcap: not there: {flights}: not there" in capsys.readouterr().out
    assert {"versions.txt", "settings.json"} <= set(packed(out))
