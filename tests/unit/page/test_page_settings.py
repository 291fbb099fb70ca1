"""Settings by the page: checked as those of a file, kept with its comments, undone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from companion.config import Config
from companion.config.setting_keys import dump
from companion.config_file import load_config
from companion.errors import ConfigError
from companion.page.setting_texts import settings
from companion.page.settings_file import SettingsFile, shown_value, value_of_text
from tests.support.served_page import ELSEWHERE, Answer, ServedPage

FILE = """\
# of this drone
[camera]
width = 640   # as it was calibrated
url = "rtsp://eye:secret@10.0.0.2/live"

[expert.features]
n_features = 900
"""


@pytest.fixture
def served(tmp_path: Path) -> Iterator[ServedPage]:
    with ServedPage(tmp_path, FILE) as served:
        yield served


def save(served: ServedPage, path: str = "/settings", **values: str) -> Answer:
    session, token = served.changer()
    form = {"token": token, **{name.replace("__", "."): value for name, value in values.items()}}
    answer = served.ask("POST", path, peer=ELSEWHERE, headers=session, form=form)
    if answer.status == 303:
        to = answer.headers["location"].partition("#")[0]
        return served.ask("GET", to, peer=ELSEWHERE, headers=session)
    return answer


def test_every_public_key_is_there_with_its_text_and_bounds(served: ServedPage) -> None:
    shown = served.ask("GET", "/settings", headers={"host": "localhost"}).text
    expert = served.ask("GET", "/settings?expert=1", headers={"host": "localhost"}).text
    for name in dump(Config()):
        assert f'name="{name}"' in (expert if name.startswith("expert.") else shown), name
    for it in settings("feedback", False):
        assert it.text.split(";")[0].split('"')[0][:40] in shown
    assert "From 0.001 to 100; default" in shown


def test_passwords_are_not_shown(served: ServedPage) -> None:
    shown = served.ask("GET", "/settings", headers={"host": "localhost"}).text
    assert "secret" not in shown and "rtsp://eye:***@10.0.0.2/live" in shown


def test_a_value_is_kept_and_the_daemon_told(
    served: ServedPage, capsys: pytest.CaptureFixture[str]
) -> None:
    answer = save(served, expert__feedback__max_sigma_m="0.5", camera__width="640",
                  camera__url="rtsp://eye:***@10.0.0.2/live")  # fmt: skip
    assert "expert.feedback.max_sigma_m is now 0.5." in answer.text
    text = served.config.read_text()
    assert "# of this drone" in text and "# as it was calibrated" in text and "secret" in text
    assert load_config(served.config).feedback.max_sigma_m == 0.5
    assert capsys.readouterr().out == "reload\n"


def test_a_key_that_counts_after_a_restart_says_so(served: ServedPage) -> None:
    assert "counts after a restart" in save(served, camera__width="320").text.replace("It ", "")
    later = served.ask("GET", "/settings", headers={"host": "localhost"}).text
    assert "These count after a restart: camera.width" in later


@pytest.mark.parametrize("name, text, wanted", [
    ("expert.feedback.max_sigma_m", "0", "0.01"),
    ("expert.feedback.min_quality", "many", "int"),
    ("feedback.mode", "on", "wanted one of off, odometry, vision_position, velocity"),
    ("telemetry.use", '["attitude", "attitude"]', "at most once"),
    ("telemetry.use", '["smell"]', "smell"),
])  # fmt: skip
def test_impossible_values_are_refused_in_words(
    served: ServedPage, name: str, text: str, wanted: str
) -> None:
    answer = save(served, **{name.replace(".", "__"): text, "depth__enabled": "false"})
    assert answer.status == 422 and wanted in answer.text and 'aria-invalid="true"' in answer.text
    assert served.config.read_text() == FILE


def test_a_calibration_with_which_the_daemon_would_not_start_is_refused(served: ServedPage) -> None:
    wrong = served.folder / "lens.toml"
    answer = save(served, camera__calibration=str(wrong))
    assert answer.status == 409 and "lens.toml: cannot be read" in answer.text
    wrong.write_text("width = 640\nheight = 480\n")
    assert "the key fx is missing" in save(served, camera__calibration=str(wrong)).text
    assert served.config.read_text() == FILE


def test_what_was_changed_is_listed_and_undone(served: ServedPage) -> None:
    save(served, expert__features__n_features="1000", depth__enabled="false")
    answer = save(served, camera__url="rtsp://eye:hidden@10.0.0.2/live")
    changed = SettingsFile(served.config, served.flights).changes()
    assert [(c.name, c.before, c.after) for c in changed[:2]] == [
        ("expert.features.n_features", "900", "1000"), ("depth.enabled", None, "false"),
    ]  # fmt: skip
    assert "Undo the change of depth.enabled" in answer.text
    for each in changed:
        save(served, "/settings/undo", number=str(each.number))
    assert load_config(served.config) == load_config_of(served.folder, FILE)
    assert "not known" in save(served, "/settings/undo", number="999").text


def load_config_of(folder: Path, text: str) -> Config:
    (folder / "other.toml").write_text(text, "utf-8")
    return load_config(folder / "other.toml")


def test_changes_are_not_for_everybody(served: ServedPage) -> None:
    save(served, camera__url="rtsp://eye:hidden@10.0.0.2/live")
    (path,) = served.flights.glob(".page-changes*")
    assert path.stat().st_mode & 0o777 == 0o600
    assert "hidden@" not in served.ask("GET", "/settings", headers={"host": "localhost"}).text


def test_a_restart_is_ordered_where_something_starts_it_again(
    served: ServedPage, capsys: pytest.CaptureFixture[str]
) -> None:
    assert save(served, "/restart").status == 200
    assert capsys.readouterr().out == "restart\n"


def test_and_refused_where_nothing_does(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with ServedPage(tmp_path, supervised=False) as served:
        assert save(served, "/restart").status == 409
    assert capsys.readouterr().out == ""


def test_without_a_file_nothing_is_kept(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="without --config"):
        SettingsFile(None, tmp_path).set({"depth.enabled": False})


@pytest.mark.parametrize("text", ["depth = {enabled = true}\n", "depth.enabled = true\n", ""])
def test_files_written_otherwise_are_changed_or_refused_whole(tmp_path: Path, text: str) -> None:
    path = tmp_path / "companion.toml"
    path.write_text(text, "utf-8")
    try:
        SettingsFile(path, tmp_path).set({"depth.enabled": False, "expert.depth.min_zncc": 0.6})
    except ConfigError:
        assert path.read_text() == text
        return
    read = load_config(path)
    assert not read.depth.enabled and read.depth.min_zncc == 0.6


def test_forms_say_values_as_they_read_them() -> None:
    for name, value in dump(Config()).items():
        assert value_of_text(name, shown_value(value)) == value, name


def test_a_password_that_is_not_shown_is_not_kept_as_stars(served: ServedPage) -> None:
    before = served.config.read_text()
    answer = save(served, camera__url="rtsp://eye:***@10.0.0.3/live")
    assert answer.status == 422 and "type it again" in answer.text
    assert served.config.read_text() == before
