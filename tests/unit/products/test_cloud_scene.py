"""The cloud of the page, as it is packed, and as a browser draws and measures it."""

from __future__ import annotations

import base64
import io
import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Page, sync_playwright

from companion.geometry.geodesy import GeoOrigin, geodetic_from_ned
from companion.geometry.transforms import Pose
from companion.products.cloud import Cloud
from companion.products.flight_result import FlightResult
from companion.products.report.cloud_scene import (
    PlacedKeyframe,
    cloud_scene,
    coarse_to_fine,
)
from companion.products.report.report_json import report
from companion.products.report.report_page import report_page
from tests.support.flights import flown

CHROMIUM = Path("/usr/bin/chromium")
OPTIONS = [
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--disable-gpu-sandbox",
]  # fmt: skip
DRAWN = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
"""By software, as on a machine without a graphics card."""
NOT_DRAWN = ["--disable-gpu", "--disable-3d-apis"]
needs_chromium = pytest.mark.skipif(not CHROMIUM.exists(), reason="apt install chromium")
ORIGIN = GeoOrigin(47.3977, 8.5456, 488.125)


def cloud_of(points: np.ndarray[tuple[int, ...], np.dtype[np.float64]], red: int) -> Cloud:
    """Grey points, one of them red."""
    n = len(points)
    rgb = np.full((n, 3), 120, np.uint8)
    rgb[red] = [255, 0, 0]
    return Cloud(
        points.astype(np.float32), rgb, np.ones(n, np.float32), np.zeros((n, 3), np.float32),
        np.full(n, np.nan, np.float32),
    )  # fmt: skip


def test_points_come_back_within_half_a_step(rng: np.random.Generator) -> None:
    points = rng.uniform([-200, 50, -30], [100, 90, 5], (5000, 3))
    scene = cloud_scene(cloud_of(points, 7), [points[:40]], [], (0.0, 0.5), "m", ORIGIN)
    assert scene is not None
    facts = json.loads(scene.facts)
    data = base64.b64decode(scene.points)
    assert len(data) == 9 * facts["n"] == 9 * 5000
    steps = np.frombuffer(data, "<u2", 3 * 5000).reshape(-1, 3)
    colours = np.frombuffer(data, np.uint8, offset=6 * 5000).reshape(-1, 3)
    order = coarse_to_fine(points.astype(np.float32))
    back = np.array(facts["low"]) + steps * facts["step"]
    assert facts["step"] == pytest.approx(300 / 65535, rel=0.01)
    np.testing.assert_allclose(back, points[order], atol=0.51 * facts["step"] + 1e-5)
    assert colours[list(order).index(7)].tolist() == [255, 0, 0]
    np.testing.assert_allclose(facts["paths"][0][:3], points[0], atol=5e-4)


def test_all_of_the_path_is_in_sight_at_first(rng: np.random.Generator) -> None:
    """It is flown around what is mapped; its height is not to push the cloud out of the middle."""
    points = rng.uniform([-20, -20, -10], [20, 20, 0], (500, 3))
    path = np.array([[-90.0, 0, -200], [0, 80, -200], [70, 0, -200]])
    scene = cloud_scene(cloud_of(points, 7), [path[:2], path[2:]], [], (0.0, 0.5), "m", None)
    assert scene is not None
    low, high = json.loads(scene.facts)["around"]
    assert low[0] == -90 and high[:2] == [70, 80] and -20 <= low[1] < -18 and low[2] > -11


def test_each_beginning_is_spread_evenly(rng: np.random.Generator) -> None:
    """Of a plane of 64 squares each prefix has a like number in each square."""
    points = np.column_stack([rng.uniform(0, 80, (64_000, 2)), np.zeros(64_000)])
    order = coarse_to_fine(points)
    assert sorted(order) == list(range(64_000))
    for n in (640, 6400):
        cell = (points[order[:n], :2] // 10).astype(int)
        counts = np.bincount(cell[:, 0] * 8 + cell[:, 1], minlength=64)
        # by chance alone the spread would be the root of the mean
        assert counts.std() < 0.45 * np.sqrt(n / 64)


def test_no_more_points_than_a_page_may_have(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.products.report.cloud_scene.MAX_POINTS", 300)
    points = rng.uniform(0, 10, (1000, 3))
    scene = cloud_scene(cloud_of(points, 0), [], [], (0.0, 0.5), "m", None)
    assert scene is not None
    assert scene.n_points == 300
    assert len(base64.b64decode(scene.points)) == 2700
    assert cloud_scene(cloud_of(points, 0).part(slice(0, 0)), [], [], (0, 0), "m", None) is None


def test_keyframes_lie_where_the_final_map_has_them() -> None:
    result = FlightResult()
    for message in flown.messages():
        result.take(message)
    places = result.keyframes()
    assert [keyframe_id for keyframe_id, _, _ in places] == list(range(12))
    for keyframe_id, _, pose in places:
        true = flown.world_from_camera(keyframe_id * flown.PER_KEYFRAME)
        np.testing.assert_allclose(pose.matrix(), true.matrix(), atol=1e-9)


# A plane of 60 m by 40 m, 3 m below the origin, and one red point on a pole over it.
RED_NED = np.array([12.0, 7.0, -4.0])


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of the synthetic flight, with a cloud of which a point is known."""
    north, east = np.meshgrid(np.arange(-30, 30, 0.25), np.arange(-20, 20, 0.25), indexing="ij")
    points = np.stack([north.ravel(), east.ravel(), np.full(north.size, 3.0)], 1)
    result = FlightResult()
    for message in flown.messages():
        result.take(message)
    facts = flown.facts(origin=ORIGIN)
    poses, cloud = result.poses(), cloud_of(np.vstack([points, RED_NED]), -1)
    page = report_page(result, facts, poses, cloud, report(result, facts, poses, cloud))
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_bytes(page)
    return path


@pytest.fixture
def page(page_file: Path) -> Iterator[Page]:
    with sync_playwright() as tools:
        browser = tools.chromium.launch(executable_path=CHROMIUM, args=[*OPTIONS, *DRAWN])
        page = browser.new_page(viewport={"width": 900, "height": 800})
        faults: list[str] = []
        page.on("console", lambda message: faults.append(message.text))
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("request", lambda r: faults.append(r.url) if r.url[:5] != "data:" else None)
        page.goto(page_file.as_uri())
        page.wait_for_function("document.getElementById('scene').view?.matrix")
        yield page
        browser.close()
        assert faults == [page_file.as_uri()]  # of which the page itself is none


def picture(page: Page) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """What the view shows, after the next two frames."""
    page.evaluate("new Promise(f => requestAnimationFrame(() => requestAnimationFrame(f)))")
    data = page.locator("#scene canvas").screenshot()
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), np.int64)


def red_place(page: Page) -> dict[str, float]:
    """Middle of the red point in the picture."""
    shown = picture(page)
    rows, columns = np.nonzero((shown[..., 0] > 150) & (shown[..., 1:].max(-1) < 60))
    assert len(rows)
    return {"x": float(columns.mean()), "y": float(rows.mean())}


@needs_chromium
def test_a_browser_draws_and_measures(page: Page) -> None:
    canvas, said = page.locator("#scene canvas"), page.locator(".scene-said")
    assert page.locator("#scene-without").is_hidden()
    shown = picture(page)
    assert (np.abs(shown - 120).max(-1) < 12).mean() > 0.1  # the plane
    page.get_by_role("button", name="Path").click()
    page.get_by_role("button", name="Keyframes").click()
    page.get_by_role("button", name="Above").click()
    red = red_place(page)
    canvas.click(position=red)  # type: ignore[arg-type]
    text = said.text_content() or ""
    latitude, longitude, altitude = geodetic_from_ned(RED_NED[None], ORIGIN)[0]
    assert "north 12.00 m, east 7.00 m, down -4.00 m" in text
    assert f"{latitude:.7f}°, {longitude:.7f}°, {altitude:.2f} m" in text
    canvas.click(position={"x": red["x"], "y": red["y"] + 40})
    text = said.text_content() or ""
    found = re.search(r"2   north (\S+) m, east (\S+) m, down 3.00 m;", text)
    assert found is not None
    away = np.array([float(found[1]), float(found[2]), 3.0]) - RED_NED
    level = np.linalg.norm(away[:2])
    assert f"distance {np.linalg.norm(away):.2f} m: level {level:.2f} m, height -7.00 m" in text
    page.get_by_role("button", name="Clear").click()
    assert said.text_content() == ""


@needs_chromium
def test_keys_and_fingers_move_it(page: Page) -> None:
    seen = [picture(page)]

    def moved() -> bool:
        """It looks different now."""
        page.wait_for_timeout(250)  # all points are drawn again once it rests
        seen.append(picture(page))
        return bool(np.abs(seen[-1] - seen[-2]).mean() > 1)

    canvas = page.locator("#scene canvas")
    canvas.focus()
    for key in ("ArrowLeft", "ArrowUp", "Shift+ArrowRight", "+", "Home"):
        page.keyboard.press(key)
        assert moved(), key
    assert np.abs(seen[-1] - seen[0]).mean() < 1
    page.keyboard.press("Enter")
    assert (page.locator(".scene-said").text_content() or "").startswith("1 ")
    page.keyboard.press("Escape")
    box = canvas.bounding_box()
    assert box is not None
    x, y = box["x"] + 300, box["y"] + 300
    fingers = page.context.new_cdp_session(page)

    def touch(kind: str, *places: tuple[float, float]) -> None:
        points = [{"x": x + u, "y": y + v, "id": k} for k, (u, v) in enumerate(places)]
        fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    for end in (((80.0, 0.0),), ((-60.0, 0.0), (120.0, 0.0))):
        begin = ((0.0, 0.0), (60.0, 0.0))[: len(end)]
        touch("touchStart", *begin)
        touch("touchMove", *end)
        touch("touchMove", *end)
        touch("touchEnd")
        assert moved(), end


@needs_chromium
def test_a_browser_that_cannot_draw_says_so(page_file: Path) -> None:
    with sync_playwright() as tools:
        browser = tools.chromium.launch(executable_path=CHROMIUM, args=[*OPTIONS, *NOT_DRAWN])
        page = browser.new_page()
        page.goto(page_file.as_uri())
        assert "no WebGL 2" in (page.locator("#scene-without").text_content() or "")
        assert page.locator("#scene").is_hidden()
        browser.close()


def test_a_keyframe_without_a_time_is_told() -> None:
    cloud = cloud_of(np.zeros((1, 3)), 0)
    placed = PlacedKeyframe(3, None, Pose.identity())
    scene = cloud_scene(cloud, [], [placed], (0.0, 0.0), "map units", None)
    assert scene is not None
    facts = json.loads(scene.facts)
    assert facts["keyframes"] == [
        {"id": 3, "t_s": None, "at": [0, 0, 0], "axes": [1, 0, 0, 0, 1, 0, 0, 0, 1]}
    ]
    assert facts["earth"] is None
