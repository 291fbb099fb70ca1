from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import pytest

from companion.config import MEASUREMENTS, Config
from companion.config.passwords import command_shown, with_passwords_hidden, without_passwords
from companion.config.setting_keys import dump, value_of_key
from companion.config_file import current_key, load_config, shown, to_toml, values_in
from companion.errors import ConfigError
from companion.page.setting_texts import settings
from tests.support.settings_text import described_toml, settings_page

ROOT = Path(__file__).parents[2]
DESCRIBED, PAGE = ROOT / "config/companion.toml", ROOT / "docs/settings.md"
BEFORE = ROOT / "tests/support/reference/companion_0_1_0.toml"
SINCE = {
    "camera.exposure", "computer.profile", "expert.distributed.ros_domain",
    "camera.readout_ms", "expert.export.mesh_m", "expert.link.gimbal_hz",
    "expert.mount.gimbal_delay_ms",
    "expert.mount.gimbal_sigma_deg", "mount.type", "feedback.flow", "feedback.global_position",
    "feedback.obstacles_3d",
    "expert.gps.satellites_set", "gps.switch_source", "expert.gps.vision_set",
    "landing.id", "landing.marker", "landing.size_m", "map.use",
    "page.listen", "telemetry.use", "expert.video.kbit_s", "video.overlay", "video.listen",
}  # fmt: skip
"""Keys that version did not have."""


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


def no_warning(line: str) -> None:
    raise AssertionError(line)


def test_nothing_given_is_the_defaults() -> None:
    assert load_config(None) == Config()


def test_file_changes_its_keys_and_no_others(tmp_path: Path) -> None:
    path = write(tmp_path, '[opencl]\ndevice = "gpu"\n[expert.depth]\nstride = 7\n')
    config = load_config(path)
    assert config.opencl.device == "gpu"
    assert config.depth.stride == 7
    unchanged = dataclasses.replace(config, opencl=Config().opencl, depth=Config().depth)
    assert unchanged == Config()
    assert config.depth.min_zncc == Config().depth.min_zncc


def test_overrides_win_over_the_file_and_the_last_one_wins(tmp_path: Path) -> None:
    path = write(tmp_path, "[expert.depth]\nstride = 7\n")
    assert load_config(path, ["expert.depth.stride=8", "expert.depth.stride = 6"]).depth.stride == 6


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


@pytest.mark.parametrize(
    ("text", "value"), [("auto", "auto"), ('"auto"', "auto"), ("100", 100.0), ("0", 0.0)]
)
def test_a_rate_may_be_a_word(text: str, value: str | float, tmp_path: Path) -> None:
    config = load_config(None, [f"expert.link.imu_hz={text}"])
    assert config.link.imu_hz == value and type(config.link.imu_hz) is type(value)
    path = tmp_path / "written.toml"
    path.write_text(to_toml(config), "utf-8")
    assert load_config(path) == config
    path.write_text(f"[link]\nimu_hz = {text if text != 'auto' else repr(text)}\n", "utf-8")
    assert load_config(path, warn=lambda _line: None) == config  # as of the version before


@pytest.mark.parametrize("text", ["fast", "1001", "-1", "true"])
def test_a_rate_that_is_neither_says_both(text: str) -> None:
    with pytest.raises(ConfigError, match="wanted auto or a number from 0 to 1000, given is"):
        load_config(None, [f"expert.link.imu_hz={text}"])


def test_unknown_key_names_the_nearest(tmp_path: Path) -> None:
    message = refusal(write(tmp_path, "[features]\nnfeatures = 500\n"))
    assert "flight.toml" in message
    assert "features.nfeatures" in message
    assert "did you mean expert.features.n_features?" in message


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("tracking.stride", "expert.depth.stride"),
        ("expert.camera.source", "camera.source"),
        ("expert.camera.gian", "expert.camera.gain"),
        ("expert.stride", "expert.depth.stride"),
    ],
)
def test_key_in_the_wrong_section_is_found_in_its_own(name: str, meant: str) -> None:
    assert f"did you mean {meant}?" in refusal(None, f"{name}=3")


def test_unknown_section_names_the_nearest(tmp_path: Path) -> None:
    assert "[opencl]" in refusal(write(tmp_path, "[open_cl]\ndevice = 'x'\n"))
    assert "[opencl]" in refusal(write(tmp_path, "[open_cl]\n"))
    assert "[expert.features]" in refusal(write(tmp_path, "[expert.fatures]\n"))
    assert "[opencl]" in refusal(None, "opncl.device=x")


def test_key_outside_a_section(tmp_path: Path) -> None:
    assert "device" in refusal(write(tmp_path, "device = 'x'\n"))
    assert "opencl is a section" in refusal(write(tmp_path, "opencl = 'x'\n"))


@pytest.mark.parametrize(
    ("override", "wanted", "given"),
    [
        ("expert.depth.stride=2.5", "a whole number", "2.5"),
        ("expert.depth.stride=true", "a whole number", "True"),
        ("depth.enabled=1", "true or false", "1"),
        ("depth.enabled=yes", "true or false", "'yes'"),
        ("cloud.voxel_m=wide", "a number", "'wide'"),
        ("cloud.voxel_m=[1]", "a number", "[1]"),
        ("cloud.voxel_m=", "a number", "''"),
        ("cloud.voxel_m=nan", "", "nan"),
        ("cloud.voxel_m=inf", "<= 100", "inf"),
        ("cloud.voxel_m=-1", ">= 0.001", "-1"),
        ("expert.depth.stride=9", "<= 8", "9"),
        ("expert.depth.stride=0", ">= 1", "0"),
        ("feedback.mode=on", "off, odometry, vision_position, velocity", "'on'"),
        ("router.clients=[1]", "text in the list", "[1]"),
        ("telemetry.use=attitude", "a list of attitude, imu, position", "'attitude'"),
        ('telemetry.use=["compass"]', "depth, each at most once", "['compass']"),
        ("telemetry.use=[true]", "a list of attitude", "[True]"),
        ('telemetry.use=["imu", "range", "imu"]', "once", "['imu', 'range', 'imu']"),
        ("page.listen=9880", "HOST:PORT", "'9880'"),
        ("page.listen=0.0.0.0:80x", "HOST:PORT", "'0.0.0.0:80x'"),
        ("stream.listen=0.0.0.0:65536", "HOST:PORT", "'0.0.0.0:65536'"),
        ("video.listen=::1:8554", "HOST:PORT", "'::1:8554'"),
        ("video.listen=:8554", "HOST:PORT", "':8554'"),
    ],
)
def test_wrong_value_says_what_was_wanted_and_given(override: str, wanted: str, given: str) -> None:
    message = refusal(None, override)
    assert override.split("=")[0] in message
    assert wanted in message.split(": ", 2)[2]
    assert message.endswith(f", given is {given}")


@pytest.mark.parametrize("address", ["", "0.0.0.0:0", "drone.local:9870", "[::1]:65535"])
def test_where_something_may_listen(address: str) -> None:
    assert load_config(None, [f"stream.listen={address}"]).stream.listen == address


@pytest.mark.parametrize("override", ["", "=", "stride=3", "depth=3", "depth.=3", ".stride=3"])
def test_override_without_its_parts(override: str) -> None:
    assert "section.key=value" in refusal(None, override)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    assert "No such file" in refusal(tmp_path / "none.toml")
    assert "directory" in refusal(tmp_path)
    assert "line 2" in refusal(write(tmp_path, "[cloud]\nvoxel_m = = 1\n"))
    (tmp_path / "latin.toml").write_bytes(b"# caf\xe9\n")
    assert "UTF-8" in refusal(tmp_path / "latin.toml")


def test_a_list_of_words_is_any_part_of_them(tmp_path: Path) -> None:
    path = write(tmp_path, '[telemetry]\nuse = ["range", "attitude"]\n')
    assert load_config(path).telemetry.use == ("range", "attitude")
    assert load_config(path, ['telemetry.use=["imu"]']).telemetry.use == ("imu",)
    assert load_config(path, ["telemetry.use=[]"]).telemetry.use == ()
    assert load_config(path, [f"telemetry.use={list(MEASUREMENTS)}"]) == Config()
    twice = refusal(write(tmp_path, '[telemetry]\nuse = ["imu", "imu"]\n'))
    assert "flight.toml: telemetry.use: wanted a list of attitude, imu" in twice


@pytest.mark.parametrize(
    "wanted",
    ["feedback.flow=optical_flow", "landing.marker=apriltag_36h11", 'video.overlay=["horizon"]'],
)
def test_what_a_fixed_camera_alone_gives_is_refused_with_a_gimbal(wanted: str) -> None:
    load_config(None, [wanted])
    with pytest.raises(ConfigError, match=r"mount\.type is gimbal"):
        load_config(None, ["mount.type=gimbal", wanted])


def test_written_configuration_reads_back_the_same(tmp_path: Path) -> None:
    use = 'telemetry.use=["imu", "attitude"]'
    config = load_config(None, ['opencl.device=a "quoted" \\ naïve', "cloud.voxel_m=1e-3", use])
    assert load_config(write(tmp_path, to_toml(config))) == config


def test_described_file_and_page_are_made_of_the_code() -> None:
    assert DESCRIBED.read_text("utf-8") == described_toml()
    assert PAGE.read_text("utf-8") == settings_page()


def test_each_key_has_a_text() -> None:
    for expert in (False, True):
        for section in dataclasses.fields(Config):
            for each in settings(section.name, expert):
                assert re.fullmatch(r".{9,}\.", each.text), each.name


def test_described_file_has_every_public_key_with_its_default(tmp_path: Path) -> None:
    assert load_config(DESCRIBED, warn=no_warning) == Config()
    opened = re.sub(r"^#(?=\w+ = )", "", DESCRIBED.read_text("utf-8"), flags=re.MULTILINE)
    path = write(tmp_path, opened)
    assert load_config(path, warn=no_warning) == Config()
    assert set(values_in(path)) == {name for name in dump(Config()) if "expert." not in name}


def test_defaults_are_themselves_allowed(tmp_path: Path) -> None:
    assert load_config(write(tmp_path, to_toml(Config())), warn=no_warning) == Config()


def test_a_file_of_the_version_before_counts_and_each_old_key_is_told() -> None:
    told: list[str] = []
    config = load_config(BEFORE, warn=told.append)
    before = values_in(BEFORE)
    for name, value in before.items():
        now = current_key(name)
        line = f"{BEFORE}: {name} is now {now}" if now else f"{BEFORE}: {name} has no effect"
        assert any(each.startswith(line) for each in told) == (now != name)
        if now:
            wanted = tuple(value) if isinstance(value, list) else value
            assert value_of_key(config, now) == wanted != value_of_key(Config(), now)
    assert len(told) == sum(current_key(name) != name for name in before)
    assert {current_key(name) for name in before} - {""} == set(dump(Config())) - SINCE


def test_an_old_key_on_the_command_line_counts() -> None:
    told: list[str] = []
    config = load_config(None, ["features.n_features=500", "mapping.window=3"], told.append)
    assert config == load_config(None, ["expert.features.n_features=500"])
    assert told == [
        "--set features.n_features=500: features.n_features is now expert.features.n_features",
        "--set mapping.window=3: mapping.window has no effect any more, 10 counts: take it out",
    ]


def test_a_key_set_by_both_names_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, "[camera]\ngain = 3\n[expert.camera]\ngain = 4\n")
    assert "camera.gain is now expert.camera.gain, which is set too" in refusal(path)


def test_each_line_is_said_once(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = write(tmp_path, "[camera]\ngain = 3\n")
    assert load_config(path) == load_config(path)
    assert capsys.readouterr().err == f"companion: {path}: camera.gain is now expert.camera.gain\n"


def test_passwords_are_not_shown() -> None:
    config = load_config(None, ["camera.url=rtsp://pilot:s3cret@10.0.0.2:554/main"])
    assert shown(config)["camera"]["url"] == "rtsp://pilot:***@10.0.0.2:554/main"
    assert "s3cret" in to_toml(config)  # which is read back
    assert without_passwords("run --set camera.url=rtsp://a:b@c/") == (
        "run --set camera.url=rtsp://a:***@c/"
    )
    found = load_config(None, ['expert.distributed.connect=["tls/10.0.0.2:7447?password=s3cret"]'])
    assert shown(found)["expert"]["distributed"]["connect"] == ("tls/10.0.0.2:7447?password=***",)


@pytest.mark.parametrize("text", [
    "rtsp://eye:s3@cret@10.0.0.2/main",
    "rtsp:/eye:s3cret@10.0.0.2/main",
    'url = "rtsp:eye:s3cret@10.0.0.2/main"',
    "rtspsrc location=rtsp://10.0.0.2/ user-id=eye user-pw=s3cret ! rtph264depay",
    'rtspsrc user-pw="s3 cret" ! decodebin',
    "http://10.0.0.2/live?user=eye&password=s3cret&channel=1",
    "srtsrc uri=srt://10.0.0.2:8890?mode=caller&passphrase=s3cret ! tsdemux",
    "https://10.0.0.2/live?access_token=s3cret",
])  # fmt: skip
def test_nor_are_those_of_pipelines_and_queries(text: str) -> None:
    seen = without_passwords(text)
    assert "cret" not in seen and "***" in seen
    assert "10.0.0.2" in seen or "10.0.0.2" not in text


def test_what_only_looks_alike_is_shown() -> None:
    text = '{"a": "12:30:45", "b":"c","d:e":"pilot@10.0.0.2"} at 12:30:45 pilot@10.0.0.2'
    assert without_passwords(text) == text


def test_a_file_without_passwords_is_read_back(tmp_path: Path) -> None:
    """A quote within a value is written as two characters, which ends no password."""
    pipeline = 'rtspsrc user-pw="s3 cret" user-id=eye ! decodebin'
    config = load_config(None, [f"camera.pipeline={pipeline}"])
    text = to_toml(with_passwords_hidden(config))
    assert "cret" not in text
    read = load_config(write(tmp_path, text))
    assert read.camera.pipeline == "rtspsrc user-pw=*** user-id=eye ! decodebin"


def test_a_command_is_shown_without_where_the_program_lies() -> None:
    argv = ["/home/pilot/.venv/bin/companion", "replay", "a flight", "--set", "x=rtsp://a:b@c/"]
    assert command_shown(argv) == "companion replay 'a flight' --set x=rtsp://a:***@c/"
