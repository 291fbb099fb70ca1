"""Work that the page starts in processes of its own: begun, refused, failed, cancelled."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from companion.calibration.chart import parse_chart
from companion.page import background_work
from companion.page.views.lens_views import BOARD
from drivers.system.low_priority import processor_time_s
from tests.support.served_page import ELSEWHERE, Answer, ServedPage

NAME = "00001-2026-11-19T10-00-00Z"
PATIENCE_S = 140.0
"""Such work gets what nobody else wants: beside other tests hardly anything."""


@pytest.fixture
def served(tmp_path: Path) -> Iterator[ServedPage]:
    with ServedPage(tmp_path) as served:
        (served.flights / NAME).mkdir()
        (served.flights / NAME / "flight.mcap").write_bytes(b"no recording")
        yield served


def post(served: ServedPage, path: str, **form: str) -> Answer:
    headers, token = served.changer()
    return served.ask("POST", path, headers=headers, peer=ELSEWHERE, form={"token": token, **form})


def until(served: ServedPage, path: str, words: str, said: bool = True) -> str:
    """The fragment, once it says something, or says it no more."""
    end_s = time.monotonic() + PATIENCE_S
    while (words in (text := served.ask("GET", path, headers={"host": "localhost"}).text)) != said:
        assert time.monotonic() < end_s, text
        served.now_s += 1.0  # the page allows a peer some questions a second
        time.sleep(0.05)
    return text


@pytest.mark.parametrize(
    ("begin", "panel", "words"),
    [
        ("/setup/lens/begin", "/setup/lens/panel", "Not calibrated: no flight is recorded now"),
        ("/setup/mount/begin", "/setup/mount/panel", "Not found: no flight is recorded now"),
        (f"/flights/{NAME}/replay", f"/flights/{NAME}/replay/panel", "not an MCAP file"),
    ],
)
def test_a_work_that_fails_says_why(served: ServedPage, begin: str, panel: str, words: str) -> None:
    assert post(served, begin).status == 303
    until(served, panel, words)
    assert not list((served.flights / NAME).glob("replay-*"))


def test_a_replay_tells_how_much_processor_time_it_gets_until_it_is_stopped(
    served: ServedPage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(background_work, "LOOK_EVERY_S", 0.01)
    told = processor_time_s(os.getpid())
    assert told > 0 and processor_time_s(0) == 0
    assert post(served, f"/flights/{NAME}/replay").status == 303
    until(served, f"/flights/{NAME}/replay/panel", " s of processor time in ")
    until(served, "/flights/another/replay/panel", "Another work of the page runs")
    assert post(served, f"/flights/{NAME}/replay/stop").status == 303
    until(served, "/flights/another/replay/panel", "Another work of the page runs", said=False)
    panel = until(served, f"/flights/{NAME}/replay/panel", "Replay it")
    assert "Not replayed" not in panel and "Replayed." not in panel


def test_nothing_heavy_is_begun_while_armed_or_without_the_right(served: ServedPage) -> None:
    for path in ("/setup/lens/begin", "/setup/mount/begin", f"/flights/{NAME}/replay"):
        assert served.ask("POST", path, peer=ELSEWHERE, form={"token": "x"}).status == 403
        served.status["armed"] = True
        assert post(served, path).status == 409
        served.status["armed"] = False
    panel = served.ask("GET", "/setup/lens/panel", headers={"host": "localhost"}).text
    assert "Not calibrated" not in panel


def test_an_impossible_setting_of_a_replay_is_refused(served: ServedPage) -> None:
    answer = post(served, f"/flights/{NAME}/replay", settings="depth.enabled=perhaps")
    assert answer.status == 409 and "depth.enabled" in answer.text


def test_the_board_on_the_page_is_the_one_that_is_looked_for() -> None:
    chart = parse_chart(BOARD)
    static = Path(__file__).parents[3] / "companion/page/static/board.svg"
    drawn = static.read_text().partition(' d="')[2].partition('"')[0]
    found = []
    for each in drawn.split("z")[:-1]:
        place, down = each.removeprefix("M").split("h")[:2]
        width, height = down.split("v")
        found.append([*map(float, place.split()), float(width), float(height)])
    wanted = chart.black_m() / chart.square_m * 100
    # rows overlap, so that no browser leaves a white line between them
    assert np.allclose(np.array(found), wanted, atol=0.02)
