"""A settings file of the version before is written anew: all that counted counts, comments stay."""

from __future__ import annotations

import io
import stat
from pathlib import Path

import pytest

from companion.app.migrate_command import migrate
from companion.config_file import load_config
from companion.errors import ConfigError

BEFORE = Path(__file__).parents[2] / "support/reference/companion_0_1_0.toml"
OLD = """\
# My drone.
[camera]
width = 1280   # a new camera
# It is dark here.
gain = 3   # by trial

[features]
n_features = 900

[mapping]
# Slow computer.
window = 5
"""
NEW = """\
# My drone.
[camera]
width = 1280   # a new camera
# It is dark here.

[mapping]
# Slow computer.

[expert.camera]
gain = 3   # by trial

[expert.features]
n_features = 900
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "drone.toml"
    path.write_bytes(text.encode())
    return path


def no_warning(line: str) -> None:
    raise AssertionError(line)


def test_keys_are_renamed_and_comments_stay(tmp_path: Path) -> None:
    path, out = written(tmp_path, OLD), io.StringIO()
    path.chmod(0o640)
    migrate(path, out)
    assert path.read_text("utf-8").replace("\n\n\n", "\n\n") == NEW
    assert (tmp_path / "drone.toml.bak").read_text("utf-8") == OLD
    for each in tmp_path.iterdir():
        assert stat.S_IMODE(each.stat().st_mode) == 0o640
    assert out.getvalue().splitlines() == [
        f"{path}: camera.gain is now expert.camera.gain",
        f"{path}: features.n_features is now expert.features.n_features",
        f"{path}: mapping.window has no effect any more, 10 counts: take it out",
        f"{path}: written anew; as it was: {path}.bak",
    ]


@pytest.mark.parametrize(
    "text",
    [
        BEFORE.read_text("utf-8"),
        "features.n_features = 900\ncamera.gain = 3\nfeedback.mode = 'odometry'\n",
        'camera = { gain = 3, width = 1280 }\n"link"."imu_hz" = 5_0\n[expert]\ncamera.focus = 4\n',
        "[expert.camera]\nfocus = 4\n[camera]\r\ngain = 3\r\n[recorder]\n'flush_s' = 1 # late",
        "[distributed]\nstages = [\n  'tracking', # here\n]\nvehicle = '\u00e9'\n[depth]\n",
    ],
)
def test_what_counted_counts_and_again_there_is_nothing_to_do(tmp_path: Path, text: str) -> None:
    path, told = written(tmp_path, text), list[str]()
    before = load_config(path, warn=told.append)
    migrate(path, io.StringIO())
    assert told and load_config(path, warn=no_warning) == before
    (tmp_path / "drone.toml.bak").unlink()
    migrate(path, out := io.StringIO())
    assert out.getvalue() == f"{path}: all keys are those of this version\n"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("text", ["[camera]\ngian = 3\n", "[camera]\ngain = 'x'\n", "[camera\n"])
def test_what_cannot_be_read_is_left_as_it_is(tmp_path: Path, text: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ConfigError, match=r"drone\.toml"):
        migrate(path, io.StringIO())
    assert path.read_text("utf-8") == text and list(tmp_path.iterdir()) == [path]


def test_where_nothing_can_be_written_it_says_so(tmp_path: Path) -> None:
    path = written(tmp_path, OLD)
    (tmp_path / "drone.toml.bak").mkdir()
    with pytest.raises(ConfigError, match="cannot be written anew: Is a directory"):
        migrate(path, io.StringIO())
    assert path.read_text("utf-8") == OLD


def test_a_link_stays_one(tmp_path: Path) -> None:
    path, link = written(tmp_path, OLD), tmp_path / "link.toml"
    link.symlink_to(path)
    migrate(link, io.StringIO())
    assert link.is_symlink() and "[expert.camera]" in path.read_text("utf-8")
