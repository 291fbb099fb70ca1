"""Mount and lens set up on the page, the viewer looked at, a flight replayed, by an operator."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from companion.calibration.calibration_verdict import MAX_SIGMA_CENTRE, MAX_SIGMA_FOCAL
from companion.config_file import load_config
from companion.geometry.transforms import (
    Pose,
    angle_between,
    quaternion_from_euler,
    rotation_from_quaternion,
)
from companion.messages import Bytes
from companion.page.codes import shown
from drivers.camera.live_calibration import body_from_camera
from drivers.camera.pattern_camera import BODY_FROM_CAMERA
from drivers.images.calibration_file import read_calibration
from tests.support.browser import CHROMIUM, Browser
from tests.support.cameras.board_pictures import CHARUCO, RADTAN, BoardPictures, placings
from tests.support.cameras.http_camera import RATE_HZ
from tests.support.processes.flying import source
from tests.support.processes.paged import Paged
from tests.support.waiting import until

pytestmark = [
    pytest.mark.alone,  # flight, browser and search of the mount fill two cores
    pytest.mark.continues,
    pytest.mark.skipif(not CHROMIUM.exists(), reason="there is no Chromium: apt install chromium"),
]
PATIENCE_MS = 180_000
SIZE = 320, 240
RERUN = "/rerun/"


def in_hands(monotonic_ns: int) -> Pose:
    """Leaned, lifted and turned slowly, moved a little."""
    t_s = monotonic_ns * 1e-9
    angles = np.radians([22.0, 20.0, 25.0]) * np.sin(
        2 * math.pi * t_s * np.array([0.08, 0.11, 0.05]) + np.array([0.0, 1.0, 2.0])
    )
    place = np.array([math.sin(0.7 * t_s), math.cos(0.5 * t_s), -6.0 + 0.5 * math.sin(0.4 * t_s)])
    return Pose(rotation_from_quaternion(quaternion_from_euler(*angles)), place)


@pytest.fixture(scope="module")
def paged(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Paged]:
    folder = tmp_path_factory.mktemp("set_up")
    with Paged(folder, path=in_hands, mounted=False) as paged:
        paged.until_served()
        yield paged


@pytest.fixture(scope="module")
def browser(paged: Paged) -> Iterator[Browser]:
    with Browser(390, 844) as browser:
        page = browser.page
        page.goto(paged.url + "/pair")
        page.get_by_label("Code").fill(shown(paged.codes().change))
        page.keyboard.press("Enter")
        page.get_by_text("This device may change things.").wait_for()
        yield browser
        assert browser.asked <= {f"127.0.0.1:{paged.port}", ""}


@pytest.fixture
def page(browser: Browser) -> Iterator[Any]:
    yield browser.page
    said, browser.complaints[:] = list(browser.complaints), []
    assert said == []


def go(page: Any, paged: Paged, path: str) -> None:
    page.goto(paged.url + path)


def press(page: Any, name: str) -> None:
    page.get_by_role("button", name=name, exact=True).click(timeout=PATIENCE_MS)


def step(page: Any, title: str) -> Any:
    return page.locator(".steps li").filter(has=page.get_by_role("link", name=title, exact=True))


def told(page: Any, words: str) -> None:
    """Wait until the line of the view says something."""
    line = page.locator("#line")
    try:
        line.filter(has_text=re.compile(words)).wait_for(timeout=PATIENCE_MS)
    except Exception as error:
        raise AssertionError(f"it says: {page.locator('main').inner_text()}") from error


def boards() -> Callable[[], Bytes]:
    """Pictures of a board near and tilted, each shown for a second or so, again and again."""
    pictures = BoardPictures(RADTAN, CHARUCO)
    # a coarse camera wants them near and much tilted
    views = [pictures.picture(each) for each in placings(24, tilt_deg=50.0, width=0.7)]
    every = itertools.cycle([np.asarray(each, np.uint8) for each in views for _ in range(RATE_HZ)])
    return lambda: next(every)


def test_the_mount_is_found_by_hand(page: Any, paged: Paged) -> None:
    go(page, paged, "/setup")
    step(page, "Mount").and_(page.locator(".todo")).wait_for(timeout=PATIENCE_MS)
    step(page, "Mount").get_by_role("link", name="Find the mount").click()
    press(page, "Begin")
    for _ in range(3):  # where a machine has too much to do its flight may end meanwhile
        told(page, "^Found: roll|begin again$")
        if page.locator("#line").inner_text().startswith("Found"):
            break
        press(page, "Begin anew")
    told(page, "^Found: roll")
    press(page, "Use this mount")
    page.get_by_text("These count after a restart: mount.known").wait_for(timeout=PATIENCE_MS)
    mount = load_config(paged.config).mount
    assert mount.known
    off = angle_between(body_from_camera(mount).rotation, BODY_FROM_CAMERA.rotation)
    assert math.degrees(off) < 1.5


def test_the_lens_is_calibrated_by_a_board(page: Any, paged: Paged) -> None:
    paged.camera.shown = boards()
    go(page, paged, "/setup/lens")
    assert page.locator(".board").evaluate("it => it.naturalWidth") > 0
    press(page, "Begin")
    page.locator(".covered").wait_for(timeout=PATIENCE_MS)
    told(page, "^Calibrated, and written to")
    press(page, "Use this calibration")
    page.get_by_text("These count after a restart").filter(
        has_text=re.compile("camera.calibration")
    ).wait_for(timeout=PATIENCE_MS)
    path = load_config(paged.config).camera.calibration
    lens = read_calibration(paged.config.parent / path, *SIZE)
    # three of the standard deviations with which a calibration is accepted
    assert lens.fx == pytest.approx(RADTAN.fx / 2, rel=3 * MAX_SIGMA_FOCAL)
    off_px = 3 * MAX_SIGMA_CENTRE * SIZE[0]
    assert lens.cx == pytest.approx((RADTAN.cx + 0.5) / 2 - 0.5, abs=off_px)


def test_arming_ends_what_is_heavy(page: Any, paged: Paged) -> None:
    go(page, paged, "/setup/lens")
    press(page, "Begin anew")
    page.get_by_role("button", name="Stop", exact=True).wait_for(timeout=PATIENCE_MS)
    paged.autopilot.arm()
    told(page, "Not calibrated: the motors (were|are) armed")  # by the page, or by what it runs
    page.get_by_text("The motors are armed: nothing can be changed now.").wait_for(
        timeout=PATIENCE_MS
    )
    assert all(each.is_disabled() for each in page.locator("main form button").all())
    paged.autopilot.disarm()
    paged.camera.shown = None


def fly_shortly(paged: Paged) -> None:
    """A flight of a hundred pictures that are tracked: a replay waits for all else that runs."""
    paged.start_again()
    paged.autopilot.arm()
    paged.daemon.until(lambda health: health["tracker"] == "tracking", "tracking")
    beyond = paged.until_source("camera", "running")["n"] + 100
    paged.daemon.until(lambda health: source(health, "camera")["n"] > beyond, "flown")
    paged.autopilot.disarm()
    paged.daemon.until(lambda health: health["armed"] is False, "disarmed")
    paged.start_again()


def test_a_flight_is_replayed_again(page: Any, paged: Paged) -> None:
    page.goto("about:blank")  # it would complain of a daemon that is away
    fly_shortly(paged)
    go(page, paged, "/flights")
    page.locator(".flights a").last.click()  # the one before, which is long enough to be stopped
    page.get_by_role("heading", name="Replay again").wait_for(timeout=PATIENCE_MS)
    name = page.url.rsplit("/", 1)[1]
    press(page, "Replay it")
    told(page, r"\d+ of \d+ pictures")
    press(page, "Stop")
    page.get_by_text("Stopped: nothing is kept of it.").wait_for(timeout=PATIENCE_MS)
    page.get_by_role("button", name="Replay it").and_(page.locator(":enabled")).wait_for(
        timeout=PATIENCE_MS
    )
    assert not list((paged.daemon.flights / name).glob("replay-*"))
    go(page, paged, "/flights")
    page.locator(".flights a").filter(has_not_text="being recorded").first.click()
    page.get_by_role("heading", name="Replay again").wait_for(timeout=PATIENCE_MS)
    assert page.url.rsplit("/", 1)[1] > name
    name = page.url.rsplit("/", 1)[1]
    page.get_by_label("Other settings").fill("expert.features.n_features=400")
    page.get_by_label("Dense map").select_option("false")
    press(page, "Replay it")
    told(page, "^Replayed")
    with page.expect_response(re.compile("report.html")) as answer:
        page.get_by_role("link", name="Report of the replay").click()
    assert answer.value.status == 200
    folder = paged.daemon.flights / name / "replay-1"
    assert "n_features=400" in (folder / "report.json").read_text("utf-8")
    assert (folder / "trajectory.tum").is_file()


def test_the_viewer_is_opened_through_the_page(page: Any, paged: Paged, browser: Browser) -> None:
    go(page, paged, "/map")
    page.get_by_role("link", name="daemon.viewer").click()
    page.get_by_label("daemon.viewer").fill("web")
    press(page, "Save [daemon]")
    page.get_by_text('Changed: daemon.viewer is now "web".').wait_for(timeout=PATIENCE_MS)
    page.goto("about:blank")
    paged.start_again()
    go(page, paged, "/map")
    viewer = page.get_by_role("link", name="Open the Rerun viewer of this drone")
    viewer.wait_for(timeout=PATIENCE_MS)
    address = paged.url + viewer.get_attribute("href")
    until(lambda: page.request.get(address).status == 200, "the viewer runs")
    with page.expect_response(
        lambda answer: answer.request.method == "POST" and "/rerun." in answer.url,
        timeout=PATIENCE_MS,
    ) as stream:
        viewer.click()
    assert stream.value.status == 200 and RERUN in page.url
    page.goto("about:blank")
    # the viewer's program warns of itself; what it asks of its makers is answered in the browser
    assert [each for each in browser.complaints if not each.startswith("warning")] == []
    browser.complaints.clear()
