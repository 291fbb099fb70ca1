"""Profiles: layers of settings that fit a computer, below the user's own file."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import pytest

from companion.app.status_command import status_table
from companion.config import Config
from companion.config.computer_settings import NO_PROFILE, profile_text
from companion.config.setting_keys import dump, value_of_key, words_of
from companion.config_file import config_of_text, load_config, of_profile, values_of
from companion.errors import ConfigError
from tests.unit.app.test_cli import companion, refused

NAMES = [name for name in words_of("computer.profile") if name != NO_PROFILE]


def test_each_profile_has_its_file_and_each_file_its_profile() -> None:
    files = resources.files("companion.config").joinpath("profiles").iterdir()
    assert sorted(file.name for file in files) == sorted(f"{name}.toml" for name in NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_profile_loads_and_sets_what_it_says(name: str) -> None:
    def no_warning(line: str) -> None:
        raise AssertionError(line)

    text = profile_text(name)
    config = config_of_text(text, name, no_warning)
    said = values_of(text, name)
    assert said and not any(key.startswith("computer.") for key in said)
    assert {key: value_of_key(config, key) for key in said} == said
    loaded = load_config(None, [f"computer.profile={name}"], no_warning)
    assert loaded.computer.profile == name
    assert {**dump(loaded), "computer.profile": NO_PROFILE} == dump(config)


def test_file_goes_over_the_profile_and_set_over_both(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text('[computer]\nprofile = "pi4"\n[camera]\nrate_hz = 12.0\n')
    config = load_config(path, ["expert.features.n_features=900"])
    assert of_profile("pi4").camera.rate_hz != 12.0 == config.camera.rate_hz
    assert config.features.n_features == 900
    assert not config.depth.enabled  # the profile's, of which nobody else speaks
    assert load_config(path, ["computer.profile=none", "camera.rate_hz=30.0"]) == Config()


def test_default_value_in_a_file_goes_over_the_profile(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text("[depth]\nenabled = true\n")
    assert load_config(path, ["computer.profile=pi4"]).depth.enabled


def test_unknown_profile_names_those_there_are(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text('[computer]\nprofile = "pi9"\n')
    with pytest.raises(ConfigError, match=r"own\.toml: computer\.profile: wanted one of .*pi5"):
        load_config(path)
    result = companion("check-config", "--profile", "pi9")
    assert result.status == 2 and "pi5" in result.stderr.splitlines()[-1]
    assert "pi9" in refused(companion("check-config", "--set", "computer.profile=pi9"))


def test_profile_on_the_command_line() -> None:
    printed = companion("check-config", "--profile", "pi5").stdout
    expected = load_config(None, ["computer.profile=pi5"])
    assert config_of_text(printed, "printed") == expected != Config()


def test_status_shows_the_profile() -> None:
    assert "profile     pi5" in status_table({"profile": "pi5"}).splitlines()
    assert "profile" not in status_table({"profile": "none"})
