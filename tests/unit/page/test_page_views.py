"""Views of the page: the state in words, steps that tick themselves off, flights, advice."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from companion.config import Config
from companion.config_file import load_config
from companion.page.remedies import OF_REASON, OF_WARNING
from companion.page.setup_steps import steps
from companion.page.views.now_views import headline
from companion.pilot_messages import JOURNAL_ONLY, REASONS, SWITCHED_OFF
from companion.pilot_messages import OF_WARNING as TOLD
from drivers.recording.flights_folder import KEEP
from tests.support.served_page import ELSEWHERE, WELL, Answer, ServedPage

NAME, OTHER = "00002-2026-11-20T10-00-00Z", "00001-2026-11-19T10-00-00Z"


@pytest.fixture
def served(tmp_path: Path) -> Iterator[ServedPage]:
    with ServedPage(tmp_path) as served:
        for name in (NAME, OTHER):
            (served.flights / name).mkdir()
            (served.flights / name / "flight.mcap").write_bytes(b"recording")
        flown = served.flights / NAME
        report = {"duration_s": 75.0, "path_length": 123.4, "unit": "m", "points": 5}
        (flown / "report.json").write_text(json.dumps(report))
        (flown / "trajectory.tum").write_text("# t\n1 0 0 0 0 0 0 1\n2 5 1 0 0 0 0 1\n")
        (flown / "report.html").write_text("<script>1</script>")
        (served.folder / "secret.txt").write_text("secret")
        (flown / "link").symlink_to(served.folder / "secret.txt")
        yield served


def here(served: ServedPage, path: str) -> Answer:
    return served.ask("GET", path, headers={"host": "localhost"})


def test_each_warning_to_the_pilot_and_each_reason_has_advice() -> None:
    assert set(TOLD) <= set(OF_WARNING) <= set(TOLD) | JOURNAL_ONLY
    assert set(OF_REASON) == set(REASONS) | set(SWITCHED_OFF)


def test_the_state_is_one_line() -> None:
    assert headline(WELL, "") == (True, "Tracking, 30 poses a second go to the autopilot.")
    lost: dict[str, Any] = {**WELL, "tracker": "lost", "feedback": {"mode": "odometry"}}
    lost["feedback"]["why_not"] = "lost"
    assert headline(lost, "") == (False, "Lost, no pose is sent: lost.")
    good, line = headline({}, "no daemon runs")
    assert not good and line == "companion does not answer: no daemon runs"


def test_without_pictures_nothing_is_said_to_be_tracked(served: ServedPage) -> None:
    served.status["sources"][0] = {"name": "camera", "state": "missing"}
    served.status["feedback"] = {"mode": "odometry", "sending": False, "why_not": "position reset"}
    text = here(served, "/now/panel").text
    assert "No pictures come, no pose is sent, camera missing." in text
    assert "see the camera" in text and "<dt>Quality</dt><dd>none</dd>" in text


def test_a_warning_comes_with_what_to_do(served: ServedPage) -> None:
    served.status["warnings"] = [
        {"what": "the camera is frozen", "detail": "<b>", "good": False, "age_s": 3.0},
        {"what": "the camera is silent", "detail": "", "good": False, "age_s": 9000.0},
        {"what": "the camera is back", "detail": "", "good": True, "age_s": 1.0},
    ]
    text = here(served, "/now/panel").text
    assert "The camera is frozen" in text and "another camera or cable" in text
    assert "silent" not in text and "is back" not in text and "<b>" not in text


def test_steps_that_need_the_picture_ask_the_daemon_to_keep_it(
    served: ServedPage, capfd: pytest.CaptureFixture[str]
) -> None:
    for path in ("/setup", "/setup/lens", "/setup/mount"):
        assert '<canvas id="picture" data-needed ' in here(served, path).text
    here(served, "/now/picture?after=-1")
    assert capfd.readouterr().out == ""
    for _ in range(3):
        here(served, "/now/picture?after=-1&needed")
    assert capfd.readouterr().out == "viewer\n"


def test_pictures_and_map_are_empty_before_there_are_any(served: ServedPage) -> None:
    assert here(served, "/now/picture?after=-1").status == 204
    assert json.loads(here(served, "/now/above").body)["metric"] is False


def states(status: dict[str, Any], config: Config, found: Any = None) -> dict[str, str]:
    return {each.key: each.state for each in steps(status, config, found)}


def test_steps_tick_themselves_off() -> None:
    config = load_config(
        None, ["link.url=udpin::14550", "feedback.mode=odometry", "camera.calibration=lens.toml"]
    )
    found = {"in_the_way": [], "mode": "odometry", "n_examined": 9, "reboot_needed": False}
    status = {**WELL, "origin": {"latitude_deg": 47.0, "longitude_deg": 8.0, "altitude_m": 400.0}}
    assert set(states(status, config, found).values()) == {"done"}
    last = steps(status, config, found)[-1]
    assert last.found == "Ready: 30 poses a second go to the autopilot."


def test_it_is_not_called_ready_before_the_parameters_are_examined() -> None:
    config = load_config(None, ["link.url=udpin::14550", "feedback.mode=odometry"])
    last = steps(WELL, config, None)[-1]
    assert last.state == "unknown" and last.found.startswith("30 poses a second go")
    assert last.to == "#parameters"


@pytest.mark.parametrize("change, key, words", [
    ({"sources": [{"name": "camera", "state": "missing"}], "size": None}, "camera", "missing"),
    ({"mount_known": False}, "mount", "not known how the camera sits"),
    ({"unproven": ["mount", "lens"]}, "mount", "Nothing has shown yet"),
    ({"feedback": {"mode": "odometry", "why_not": "no metric scale"}}, "ready", "no metric scale"),
])  # fmt: skip
def test_the_last_step_names_the_first_thing_that_is_not(
    change: dict[str, Any], key: str, words: str
) -> None:
    config = load_config(None, ["link.url=udpin::14550", "feedback.mode=odometry"])
    told = {each.key: each for each in steps({**WELL, **change}, config, None)}
    assert told[key].state == "todo" and words in told["ready"].found
    assert told["ready"].found.startswith("Not ready") and told["ready"].todo


def test_flights_are_listed_the_newest_first(served: ServedPage) -> None:
    text = here(served, "/flights").text
    assert text.index(NAME) < text.index(OTHER)
    assert "1:15 min" in text and "123 m" in text and "<polyline" in text


def test_a_flight_has_its_files_and_no_others(served: ServedPage) -> None:
    text = here(served, f"/flights/{NAME}").text
    assert "Report" in text and "flight.mcap" in text and "link" not in text.split("<h2")[1]
    got = here(served, f"/flights/{NAME}/file/flight.mcap")
    assert got.body == b"recording" and "attachment" in got.headers["content-disposition"]
    for path in (f"/flights/{NAME}/file/link", f"/flights/{NAME}/file/../../secret.txt",
                 "/flights/..", "/flights/../file/secret.txt", "/flights/00009-x"):  # fmt: skip
        answer = here(served, path)
        assert answer.status == 404 and b"secret" not in answer.body.replace(b"secret.txt", b"")


def test_a_cloud_without_points_is_no_file_of_a_flight(served: ServedPage) -> None:
    flown = served.flights / NAME
    (flown / "cloud.ply").write_text("ply")
    assert "cloud.ply" in here(served, f"/flights/{NAME}").text
    (served.flights / OTHER / "cloud.ply").write_text("ply")
    (served.flights / OTHER / "report.json").write_text(json.dumps({"points": 0}))
    assert "cloud.ply" not in here(served, f"/flights/{OTHER}").text


def test_a_report_runs_without_the_session(served: ServedPage) -> None:
    policy = here(served, f"/flights/{NAME}/file/report.html").headers["content-security-policy"]
    assert policy.startswith("sandbox allow-scripts;") and "allow-same-origin" not in policy


def test_a_flight_is_called_by_its_number_and_time(served: ServedPage) -> None:
    assert "<h1" in (text := here(served, f"/flights/{NAME}").text)
    assert "Flight 2, 20 Nov 2026, 10:00 UTC</h1>" in text and "Open the report" in text
    assert "It has no report" in here(served, f"/flights/{OTHER}").text


def test_what_is_not_there_is_said_in_a_view(served: ServedPage) -> None:
    answer = served.ask("GET", "/nothing", headers={"host": "localhost", "accept": "text/html"})
    assert answer.status == 404 and "<nav" in answer.text and "no such view" in answer.text
    assert here(served, "/static/nothing.js").status == 404


def test_flights_are_kept_and_deleted(served: ServedPage) -> None:
    session, token = served.changer()

    def post(path: str) -> Answer:
        return served.ask("POST", path, peer=ELSEWHERE, headers=session, form={"token": token})

    assert post(f"/flights/{NAME}/keep").status == 303
    assert (served.flights / NAME / KEEP).exists()
    assert post(f"/flights/{NAME}/delete").status == 409 and (served.flights / NAME).is_dir()
    assert post(f"/flights/{NAME}/release").status == 303
    assert post(f"/flights/{NAME}/delete").status == 303
    assert not (served.flights / NAME).exists() and (served.flights / OTHER).is_dir()
    assert post("/flights/../delete").status == 409 and served.flights.is_dir()


def test_every_view_is_one_that_a_screen_reader_can_walk_through(served: ServedPage) -> None:
    steps = ("/setup", "/setup/lens", "/setup/mount")
    for path in ("/", "/map", "/flights", f"/flights/{NAME}", *steps, "/settings", "/pair"):
        text = here(served, path).text
        for wanted in ('lang="en"', "<main", "<nav aria-label", "<h1", 'class="skip"'):
            assert wanted in text, (path, wanted)
        for piece in text.split("<input")[1:] + text.split("<select")[1:]:
            head = piece.partition(">")[0]
            if 'type="hidden"' not in head:
                name = head.partition('id="')[2].partition('"')[0]
                assert f'<label for="{name}"' in text, (path, head)
        for piece in text.split("<canvas")[1:]:
            assert 'role="img"' in piece.partition(">")[0] and "aria-label" in piece


def test_blueos_finds_the_page_by_its_name(served: ServedPage) -> None:
    told = json.loads(served.ask("GET", "/register_service", peer=ELSEWHERE).text)
    assert {"name", "description", "icon", "company", "version", "webpage", "api"} <= set(told)
    assert told["name"] == "companion"
