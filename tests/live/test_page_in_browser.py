"""The page on a phone, in Chromium, as an operator goes through it: set up, fly, look, tidy up."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from companion.config_file import load_config
from companion.page.codes import shown
from tests.support.browser import CHROMIUM, Browser
from tests.support.processes.paged import Paged

pytestmark = [
    pytest.mark.continues,
    pytest.mark.alone,  # a flight, a browser and the page's doctor fill two cores
    pytest.mark.skipif(not CHROMIUM.exists(), reason="there is no Chromium: apt install chromium"),
]
PHONE = 390
STEPS = ("/setup", "/setup/lens", "/setup/mount")
VIEWS = ("/", "/map", "/flights", *STEPS, "/settings", "/settings?expert=1", "/pair")
SENT = re.compile(r"poses a second go to the autopilot")


@pytest.fixture(scope="module")
def paged(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Paged]:
    with Paged(tmp_path_factory.mktemp("paged")) as paged:
        paged.until_served()
        yield paged


@pytest.fixture(scope="module")
def browser(paged: Paged) -> Iterator[Browser]:
    with Browser(PHONE, 844) as browser:
        browser.page.goto(paged.url)
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
    page.get_by_role("button", name=name, exact=True).click()


def expect_refusal(browser: Browser, status: int) -> None:
    """The console tells of each answer that refuses a form."""
    assert [each for each in browser.complaints if f"status of {status}" in each]
    browser.complaints.clear()


def note(page: Any) -> str:
    return str(page.locator(".note").locator("visible=true").first.inner_text())


def told(page: Any, place: str, words: str) -> None:
    """Wait until a place of the view says something."""
    page.locator(place).filter(has_text=re.compile(words)).wait_for()


def until_footer(page: Any, words: str) -> None:
    """Open the view again until its footer says what may be changed: it was asked a second ago."""
    until_s = time.monotonic() + 60
    while words not in (said := page.locator("footer").inner_text()):
        assert time.monotonic() < until_s, f"the footer says {said!r}"
        page.wait_for_timeout(1000)
        page.reload()


def step(page: Any, title: str) -> Any:
    return page.locator(".steps li").filter(has=page.get_by_role("link", name=title, exact=True))


def test_nothing_can_be_changed_before_the_device_is_paired(page: Any, paged: Paged) -> None:
    go(page, paged, "/setup")
    for button in page.locator("main button").all():
        assert button.is_disabled()


def test_a_device_is_paired_by_the_code(page: Any, paged: Paged, browser: Browser) -> None:
    go(page, paged, "/setup")
    page.get_by_role("link", name="Pair it").click()
    page.get_by_label("Code").fill("AAAA-BBBB")
    press(page, "Pair")
    assert page.get_by_role("alert").inner_text() == "This is not one of the two codes."
    expect_refusal(browser, 403)
    page.get_by_label("Code").fill(shown(paged.codes().change))
    page.keyboard.press("Enter")
    page.wait_for_url("**/setup")
    page.get_by_text("This device may change things.").wait_for()


def test_steps_are_ticked_off_by_what_is_there(page: Any, paged: Paged) -> None:
    go(page, paged, "/setup")
    for title in ("Camera", "Lens", "Mount", "Autopilot"):
        step(page, title).and_(page.locator(".done")).wait_for()
    assert "Not examined" in step(page, "Parameters").inner_text()
    told(page, "#focus", "Sharpness")


def test_the_link_is_shared_with_the_doctor_by_a_button(page: Any, paged: Paged) -> None:
    go(page, paged, "/setup")
    press(page, "Examine the parameters")
    page.get_by_text("The daemon holds the link.").wait_for()
    press(page, "Give them one")
    assert "It counts after a restart." in note(page)
    assert load_config(paged.config).router.clients == ("tcpin:127.0.0.1:5760",)
    page.get_by_text("These count after a restart: router.clients").wait_for()
    page.goto("about:blank")  # it would complain of a daemon that is away
    paged.start_again()


def test_parameters_are_set_by_buttons(page: Any, paged: Paged) -> None:
    go(page, paged, "/setup")
    step(page, "Autopilot").and_(page.locator(".done")).wait_for()
    press(page, "Examine the parameters")
    table = page.get_by_role("table")
    table.wait_for()
    first = table.get_by_role("button").first
    words = re.fullmatch(r"Set (\w+) to ([\d.-]+)", first.get_attribute("aria-label"))
    assert words is not None
    first.click()
    page.get_by_text(f"{words[1]} is now {float(words[2]):g}").wait_for()
    page.wait_for_load_state()  # the note is there before the buttons
    assert paged.autopilot.parameters[words[1]] == pytest.approx(float(words[2]))
    if page.get_by_role("button", name="Set all that can be set").count():
        press(page, "Set all that can be set")
    step(page, "Parameters").filter(has_text="Nothing stands in the way").wait_for()


def test_a_setting_is_changed_refused_and_undone(page: Any, paged: Paged, browser: Browser) -> None:
    go(page, paged, "/settings?expert=1#expert.feedback.max_sigma_m")
    field = page.get_by_label("expert.feedback.max_sigma_m")
    field.fill("a lot")
    press(page, "Save [feedback]")
    assert "1 value is not possible" in page.get_by_role("alert").inner_text()
    expect_refusal(browser, 422)
    page.get_by_label("expert.feedback.max_sigma_m").fill("0.5")
    press(page, "Save [feedback]")
    assert note(page) == "Changed: expert.feedback.max_sigma_m is now 0.5."
    assert load_config(paged.config).feedback.max_sigma_m == 0.5
    paged.daemon.line("configuration read again")
    page.get_by_role("button", name="Undo the change of expert.feedback.max_sigma_m").first.click()
    assert note(page) == "Changed: expert.feedback.max_sigma_m is now the default."


def test_it_is_ready_and_flies(page: Any, paged: Paged) -> None:
    go(page, paged, "/setup")
    step(page, "Ready to fly").and_(page.locator(".done")).wait_for(timeout=90_000)
    paged.autopilot.arm()
    go(page, paged, "/")
    page.get_by_text(SENT).first.wait_for()
    page.get_by_text("The motors are armed: this page only looks on.").or_(
        page.locator("dl").get_by_text("armed", exact=True)
    ).first.wait_for()
    told(page, "#picture-text", r"[1-9]\d* points are tracked")
    told(page, "#above-text", "m/s")
    drawn = """() => { const it = document.getElementById('above');
      return it.getContext('2d').getImageData(0, 0, it.width, it.height).data.some(v => v); }"""
    assert page.evaluate(drawn)


def test_nothing_is_changed_in_flight(page: Any, paged: Paged) -> None:
    for view in ("/setup", "/settings"):
        go(page, paged, view)
        until_footer(page, "The motors are armed: this page only looks on.")
        assert all(each.is_disabled() for each in page.locator("main form button").all())


def test_the_map_is_moved_by_its_buttons(page: Any, paged: Paged) -> None:
    go(page, paged, "/map")
    told(page, "#above-text", "m/s")
    for name in ("Zoom in", "Zoom out", "Show all", "Follow the drone"):
        press(page, name)
    assert page.get_by_role("button", name="Follow the drone").get_attribute("aria-pressed") == (
        "true"
    )


def test_the_flight_is_kept_downloaded_and_deleted(page: Any, paged: Paged) -> None:
    paged.autopilot.disarm()
    paged.daemon.line("results so far")
    page.goto("about:blank")  # it would complain of a daemon that is away
    paged.start_again()  # which ends the flight
    paged.daemon.until(lambda health: health["armed"] is False, "disarmed")
    go(page, paged, "/flights")
    flight = page.locator(".flights a").filter(has=page.locator("polyline")).first
    flight.click()
    page.get_by_text("Report and files").wait_for()
    until_footer(page, "This device may change things.")
    with page.expect_download() as download:
        page.get_by_role("link", name="trajectory.tum").click()
    assert Path(download.value.path()).read_bytes().startswith(b"# unix_s")
    press(page, "Keep")
    assert note(page).endswith("is kept.")
    assert page.get_by_text("Delete…").count() == 0
    press(page, "Keep no longer")
    page.get_by_text("Delete…").click()
    press(page, "Delete this flight")
    assert note(page).endswith("was deleted.")


@pytest.mark.parametrize("view", VIEWS)
def test_a_view_fits_a_phone_and_a_keyboard(page: Any, paged: Paged, view: str) -> None:
    go(page, paged, view)
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"
    reached = set()
    for _ in range(5):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.getAttribute('href')"))
    assert {"/", "/map", "/flights", "/setup", "/settings"} <= reached
    small = """() => [...document.querySelectorAll('main button, main input, main select')]
      .filter(it => it.offsetParent && it.getBoundingClientRect().height < 30).length"""
    assert page.evaluate(small) == 0
