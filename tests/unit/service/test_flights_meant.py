"""Default folder of `companion flights`."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.app.cli import main
from companion.service.flights_meant import flights_meant, installed_services
from companion.service.install_paths import Places, user_places
from tests.support.flights.recorded import record


@pytest.fixture
def service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Places:
    """A user's own, whose unit and configuration are there."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    places = user_places()
    for path in (places.unit, places.config):
        path.parent.mkdir(parents=True)
        path.touch()
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return places


def test_without_a_service_it_is_here(service: Places) -> None:
    assert flights_meant(None, [], []) == Path.cwd() / "flights"
    assert flights_meant(None, ["daemon.flights=other"], []) == Path.cwd() / "other"
    service.unit.unlink()
    assert service not in installed_services()


def test_that_of_an_installed_service_lies_in_its_working_directory(service: Places) -> None:
    assert installed_services()[0] == service
    own = service.working / "flights"
    assert own == Path.cwd().parent / "home/.local/state/companion/flights"
    assert flights_meant(None, [], [service]) == own
    assert flights_meant(service.config, [], [service]) == own
    assert flights_meant(None, ["depth.enabled=false"], [service]) == own
    service.config.write_text('[daemon]\nflights = "/mnt/ssd"\n')
    assert flights_meant(None, [], [service]) == Path("/mnt/ssd")


def test_what_is_told_counts_before_a_service(service: Places) -> None:
    mine = Path("mine.toml")
    mine.write_text('[daemon]\nflights = "../f"\n')
    assert flights_meant(mine, [], [service]) == Path.cwd() / "../f"
    assert flights_meant(None, ["daemon.flights=f"], [service]) == Path.cwd() / "f"


def test_list_says_where_it_looked(service: Places, capsys: pytest.CaptureFixture[str]) -> None:
    own = service.working / "flights"
    assert main(["flights", "list"]) == 2
    assert str(own) in capsys.readouterr().err
    record(own / "2026-01-01T00-00-00Z", 3)
    assert main(["flights", "list"]) == 0
    assert f"1 recording in {own}," in capsys.readouterr().out
