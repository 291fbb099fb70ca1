from __future__ import annotations

from pathlib import Path

import pytest

import companion
from companion.app.cli import main
from companion.app.sample_flight import sample_flight
from companion.config import CameraConfig
from companion.errors import InputError
from drivers.open_flight import open_flight


def test_a_clone_has_it_beside_the_sources() -> None:
    flight = open_flight(sample_flight(), CameraConfig())
    assert flight.n_frames == 466


def test_a_package_has_it_in_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a wheel lays it out: the same files, at the place that the build names."""
    package = tmp_path / "site-packages" / "companion"
    (package / "sample" / "survey").mkdir(parents=True)
    (package / "__init__.py").write_text("")
    monkeypatch.setattr(companion, "__file__", str(package / "__init__.py"))
    with pytest.raises(InputError, match="companion demo FLIGHT takes any flight"):
        sample_flight()
    (package / "sample" / "survey" / "camera.mp4").write_bytes(b"")
    assert sample_flight() == package / "sample" / "survey"


def test_another_flight_can_be_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["demo", str(tmp_path / "nowhere"), "--out", str(tmp_path / "out")]
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert f"flight: {tmp_path / 'nowhere'}" in out
    assert "there is no such file or folder" in err
