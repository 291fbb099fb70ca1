from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest

from companion.config import Config
from companion.config_file import (
    command_shown,
    dump,
    load_config,
    shown,
    to_toml,
    without_passwords,
)
from companion.errors import ConfigError

DESCRIBED = Path(__file__).parents[2] / "config" / "companion.toml"


def write(folder: Path, text: str) -> Path:
    path = folder / "flight.toml"
    path.write_text(text, "utf-8")
    return path


def refusal(path: Path | None, *overrides: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load_config(path, overrides)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_nothing_given_is_the_defaults() -> None:
    assert load_config(None) == Config()


def test_file_changes_its_keys_and_no_others(tmp_path: Path) -> None:
    path = write(tmp_path, '[opencl]\ndevice = "gpu"\n[mapping]\nwindow = 7\n')
    config = load_config(path)
    assert config.opencl.device == "gpu"
    assert config.mapping.window == 7
    unchanged = dataclasses.replace(config, opencl=Config().opencl, mapping=Config().mapping)
    assert unchanged == Config()
    assert config.mapping.n_fixed == Config().mapping.n_fixed


def test_overrides_win_over_the_file_and_the_last_one_wins(tmp_path: Path) -> None:
    path = write(tmp_path, "[mapping]\nwindow = 7\n")
    assert load_config(path, ["mapping.window=8", "mapping.window = 9"]).mapping.window == 9


@pytest.mark.parametrize("text", ["gpu", '"gpu"', "'gpu'", " gpu "])
def test_strings_may_go_without_quotes(text: str) -> None:
    assert load_config(None, [f"opencl.device={text}"]).opencl.device == "gpu"


@pytest.mark.parametrize("text", ["3090", "0:1", "true", "a=b", "1979-05-27"])
def test_a_string_key_takes_any_text(text: str) -> None:
    assert load_config(None, [f"opencl.device={text}"]).opencl.device == text


def test_a_line_break_in_a_value_sets_nothing_else() -> None:
    config = load_config(None, ['opencl.device="a"\nother = 1'])
    assert config.opencl.device == '"a"\nother = 1'


def test_whole_numbers_are_taken_for_numbers(tmp_path: Path) -> None:
    voxel = load_config(write(tmp_path, "[cloud]\nvoxel_m = 1\n")).cloud.voxel_m
    assert voxel == 1.0
    assert isinstance(voxel, float)


def test_unknown_key_names_the_nearest(tmp_path: Path) -> None:
    message = refusal(write(tmp_path, "[features]\nnfeatures = 500\n"))
    assert "flight.toml" in message
    assert "features.nfeatures" in message
    assert "did you mean features.n_features?" in message


def test_key_in_the_wrong_section_is_found_in_its_own() -> None:
    assert "did you mean mapping.window?" in refusal(None, "tracking.window=3")


def test_unknown_section_names_the_nearest(tmp_path: Path) -> None:
    assert "[opencl]" in refusal(write(tmp_path, "[open_cl]\ndevice = 'x'\n"))
    assert "[opencl]" in refusal(None, "opncl.device=x")


def test_key_outside_a_section(tmp_path: Path) -> None:
    assert "device" in refusal(write(tmp_path, "device = 'x'\n"))
    assert "opencl is a section" in refusal(write(tmp_path, "opencl = 'x'\n"))


@pytest.mark.parametrize(
    ("override", "wanted", "given"),
    [
        ("mapping.window=2.5", "a whole number", "2.5"),
        ("mapping.window=true", "a whole number", "true or false"),
        ("depth.enabled=1", "true or false", "a whole number"),
        ("depth.enabled=yes", "true or false", "'yes'"),
        ("cloud.voxel_m=wide", "a number", "'wide'"),
        ("cloud.voxel_m=[1]", "a number", "list"),
        ("cloud.voxel_m=", "a number", "''"),
        ("cloud.voxel_m=nan", "finite", "nan"),
        ("cloud.voxel_m=inf", "finite", "inf"),
        ("cloud.voxel_m=-1", "0.001 to 100", "-1"),
        ("mapping.window=1", "2 to 100", "1"),
    ],
)
def test_wrong_value_says_what_was_wanted_and_given(
    override: str, wanted: str, given: str
) -> None:
    message = refusal(None, override)
    assert override.split("=")[0] in message
    assert wanted in message.split(" wants ")[1]
    assert given in message.split(" given is ")[1]


@pytest.mark.parametrize("override", ["", "=", "window=3", "mapping=3", "mapping.=3", ".window=3"])
def test_override_without_its_parts(override: str) -> None:
    assert "section.key=value" in refusal(None, override)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    assert "No such file" in refusal(tmp_path / "none.toml")
    assert "directory" in refusal(tmp_path)
    assert "line 2" in refusal(write(tmp_path, "[cloud]\nvoxel_m = = 1\n"))
    (tmp_path / "latin.toml").write_bytes(b"# caf\xe9\n")
    assert "UTF-8" in refusal(tmp_path / "latin.toml")


def test_written_configuration_reads_back_the_same(tmp_path: Path) -> None:
    config = load_config(None, ['opencl.device=a "quoted" \\ naïve', "cloud.voxel_m=1e-3"])
    assert load_config(write(tmp_path, to_toml(config))) == config


def test_described_file_changes_nothing_as_it_stands() -> None:
    assert load_config(DESCRIBED) == Config()


def test_described_file_has_every_key_with_its_default(tmp_path: Path) -> None:
    opened = re.sub(r"^#(?=\w+ = )", "", DESCRIBED.read_text("utf-8"), flags=re.MULTILINE)
    assert load_config(write(tmp_path, opened)) == Config()
    named = {
        section.split("]")[0]: set(re.findall(r"^(\w+) = ", section, flags=re.MULTILINE))
        for section in opened.split("\n[")[1:]
    }
    assert named == {section: set(keys) for section, keys in dump(Config()).items()}


def test_described_file_says_something_before_the_first_key_of_each_section() -> None:
    for section in DESCRIBED.read_text("utf-8").split("\n[")[1:]:
        assert section.splitlines()[1].startswith("# ")


def test_defaults_are_themselves_allowed(tmp_path: Path) -> None:
    assert load_config(write(tmp_path, to_toml(Config()))) == Config()


def test_passwords_are_not_shown() -> None:
    config = load_config(None, ["camera.url=rtsp://pilot:s3cret@10.0.0.2:554/main"])
    assert shown(config)["camera"]["url"] == "rtsp://pilot:***@10.0.0.2:554/main"
    assert "s3cret" in to_toml(config)  # which is read back
    assert without_passwords("run --set camera.url=rtsp://a:b@c/") == (
        "run --set camera.url=rtsp://a:***@c/"
    )


def test_a_command_is_shown_without_where_the_program_lies() -> None:
    argv = ["/home/pilot/.venv/bin/companion", "replay", "a flight", "--set", "x=rtsp://a:b@c/"]
    assert command_shown(argv) == "companion replay 'a flight' --set x=rtsp://a:***@c/"
