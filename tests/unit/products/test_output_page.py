from __future__ import annotations

import base64
import re
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from companion.geometry.camera import Camera
from companion.messages import PointChunk
from companion.products.flight_result import FlightResult
from companion.products.report.report_json import report
from companion.products.report.report_page import number, path_segments, report_page, when
from companion.telemetry import PositionSample, PositionSource
from tests.support.flights import flown

VOID = {"meta", "img", "br", "path", "use", "polyline", "rect", "link"}


class Reader(HTMLParser):
    """Fails on elements that do not match; collects text and attributes."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text = ""
        self.attributes: list[tuple[str, str, str]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += " ".join(data.split()) + " "


def read(page: str) -> Reader:
    reader = Reader()
    reader.feed(page)
    reader.close()
    assert reader.open == []
    return reader


def page_of(result: FlightResult, **changes: object) -> str:
    facts = flown.facts(**changes)
    poses, cloud = result.poses(), result.cloud(0.3)
    return report_page(result, facts, poses, cloud, report(result, facts, poses, cloud)).decode()


@pytest.fixture(scope="module")
def page() -> str:
    result = FlightResult()
    for message in flown.messages():
        result.take(message)
    return page_of(result)


def test_page_needs_nothing_else(page: str) -> None:
    for tag, name, value in read(page).attributes:
        if name in ("src", "href", "xlink:href", "srcset", "data"):
            assert value.startswith(("data:", "#")), (tag, name, value[:60])
    assert re.findall(r"url\((?!#)", page) == []
    assert "@import" not in page
    assert page.count("<script") == 3  # the view in 3-D: its numbers, its points, its program


def test_page_has_its_pictures_and_plots(page: str) -> None:
    sources = [value for tag, name, value in read(page).attributes if (tag, name) == ("img", "src")]
    assert len(sources) == 3 + 2 * 6  # three views of the cloud; image and depth of six keyframes
    for source in sources:
        data = np.frombuffer(base64.b64decode(source.split(",", 1)[1]), np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
        assert image is not None
        assert np.ptp(image) > 50
    assert page.count("<svg") == 4 + 3 + 1  # plots; paths over the views; axes


def test_elements_ids_are_unique(page: str) -> None:
    ids = [value for _, name, value in read(page).attributes if name == "id"]
    used = {v[1:] for _, n, v in read(page).attributes if n in ("href", "xlink:href")}
    used |= set(re.findall(r"url\(#([^)]+)\)", page))
    assert used <= set(ids)
    assert all(ids.count(name) == 1 for name in used)


def test_plots_take_the_colours_of_the_page(page: str) -> None:
    plots = re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL)
    colours = {c for plot in plots for c in re.findall(r"#[0-9a-f]{6}\b", plot)}
    assert colours <= {"#ffffff", "#000000"}  # of the patches that are not shown


def test_page_says_the_numbers(page: str) -> None:
    text = read(page).text
    for words in (
        "14 November 2023, 22:13:20 UTC", "90.8 %", "±0.8 %", "4 ± 0.8 %", "GPS positions",
        "TIMESYNC", "-83.0213 s", "14.2 ppm", "1 reboot", "late telemetry", "by 0.3 s",
        "16.6 m", "21.7 m", "512 MB",
    ):  # fmt: skip
        assert words in text, words


def test_stages_stand_in_table_and_plot_in_one_order() -> None:
    flight = FlightResult()
    for message in flown.messages():
        flight.take(message)
    times = {"n": 1, "p50_ms": 1.0, "p95_ms": 2.0}
    stages = {"a": {**times, "total_s": 0.1}, "b": {**times, "total_s": 7.0}}
    made = page_of(flight, stage_times=stages)
    assert made.index("<td>b</td>") < made.index("<td>a</td>")


def test_text_from_outside_is_escaped(page: str) -> None:
    assert "a <device>" in read(page).text
    assert "<device>" not in page
    assert "a&amp;b" in page


def test_nothing_tracked() -> None:
    result = FlightResult()
    for seq in range(30):
        result.take(flown.position(seq))
        result.take(flown.frame(seq))
        result.take(flown.track(flown.LOST[0] + seq % len(flown.LOST)))
    text = read(page_of(result, completed=False, clock=None)).text
    assert "No frame could be placed" in text
    assert "stopped before the flight's end" in text
    assert "the autopilot's own (GPS)" in text


def test_no_telemetry_and_no_scale() -> None:
    result = FlightResult()
    for message in flown.messages(known=False):
        if not isinstance(message, PositionSample):
            result.take(message)
    camera = Camera(64, 48, 60.0, 60.0, 31.5, 23.5, assumed=True)
    page = page_of(result, clock=None, origin=None, camera=camera)
    text = read(page).text
    assert "No metric scale" in text
    assert "no positions from an autopilot" in text
    assert "was assumed" in text
    assert "map units" in text
    assert "north [m]" not in page
    assert "N ↑" not in text


def test_nothing_at_all() -> None:
    text = read(page_of(FlightResult(), wall_s=0.0, stage_times={}, clock=None, origin=None)).text
    assert "0 frames" in text


def test_one_frame() -> None:
    result = FlightResult()
    for message in (flown.frame(30), flown.track(30), flown.position(30), flown.update()):
        result.take(message)
    assert "1 of 1 frames placed" in read(page_of(result)).text


def test_a_single_point() -> None:
    result = FlightResult()
    result.take(flown.chunk(1, n=1))
    result.take(flown.update())
    read(page_of(result))


def test_path_breaks_where_the_camera_was_lost() -> None:
    result = FlightResult()
    for message in flown.messages():
        result.take(message)
    parts = path_segments(result.poses())
    assert len(parts) == 2
    assert parts[0][0][-1] == flown.time_ns(flown.LOST[0] - 1)
    assert parts[1][0][0] == flown.time_ns(flown.LOST[-1] + 1)
    assert path_segments([]) == []


def test_a_clock_that_was_never_set_has_no_date() -> None:
    assert when(12_000_000_000) is None
    assert when(None) is None
    assert when(1_700_000_000 * 10**9) == "14 November 2023, 22:13:20 UTC"


@pytest.mark.parametrize(
    ("value", "text"),
    [(0, "0"), (0.0342, "0.034"), (7.26, "7.26"), (-7.26, "-7.26"), (1234.5, "1,234")],
)
def test_numbers_are_short(value: float, text: str) -> None:
    assert number(value) == text


def test_autopilot_path_before_the_video_is_left_out() -> None:
    alone, after = FlightResult(), FlightResult()
    after.take(PositionSample(flown.START_NS - 10**10, PositionSource.GPS, np.full(3, 9e5)))
    for message in flown.messages():
        if not isinstance(message, PointChunk):
            alone.take(message)
            after.take(message)
    assert page_of(after) == page_of(alone)
