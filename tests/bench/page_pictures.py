"""Pictures of the page as an operator sees it, each on a phone and at a desk; to be looked at.

    python -m tests.bench.page_pictures OUT [--only mount|lens|views]

Flies the camera and the autopilot of the tests in real time: the mount is found by hand and the
lens calibrated, with pictures while each goes on; then the other views, in flight and after it.
Prints what each view is wider than its screen by, and what the browser complained of. Once all
parts are there, OUT has the pictures of docs/page.md too: page_now.webp, page_setup.webp and
page_views.webp.
"""

from __future__ import annotations

import argparse
import io
import re
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image

from companion.page.codes import shown
from tests.live.test_set_up_in_browser import boards, in_hands
from tests.support.browser import Browser
from tests.support.cameras.http_camera import RATE_HZ
from tests.support.processes.paged import Paged

SCREENS = {"phone": (390, 844), "desk": (1280, 800)}
LONG_MS = 200_000
RATE = f"camera.rate_hz={RATE_HZ:g}"
SHEET = ("lens_6", "mount_found", "map", "flight", "settings")
SHEET_SCREEN, SHEET_GAP = (260, 563), 12
ALONE = {"now": "phone", "setup": "desk"}
"""Views that docs/page.md shows by themselves."""


class Operator:
    """A paired browser that takes pictures into a folder."""

    def __init__(self, paged: Paged, browser: Browser, out: Path) -> None:
        self._paged, self._browser, self._out = paged, browser, out
        self.page: Any = browser.page
        out.mkdir(parents=True, exist_ok=True)

    def pair(self) -> None:
        self.page.goto(self._paged.url + "/pair")
        self.take("pair")
        self.page.get_by_label("Code").fill(shown(self._paged.codes().change))
        self.page.keyboard.press("Enter")
        self.page.get_by_text("This device may change things.").wait_for()

    def go(self, path: str) -> None:
        self.page.goto(self._paged.url + path)

    def press(self, name: str) -> None:
        self.page.get_by_role("button", name=name, exact=True).click(timeout=LONG_MS)

    def told(self, words: str, place: str = "#line") -> None:
        line = self.page.locator(place).filter(has_text=re.compile(words)).first
        line.wait_for(timeout=LONG_MS)

    def take(self, name: str) -> None:
        for screen, (width, height) in SCREENS.items():
            self.page.set_viewport_size({"width": width, "height": height})
            self.page.wait_for_timeout(300)  # it draws anew
            self.page.screenshot(path=self._out / f"{name}_{screen}.png", full_page=True)
            if screen == "phone" and name in SHEET:
                self.page.screenshot(path=self._out / f"{name}_sheet.png")
            if screen == ALONE.get(name):
                with Image.open(io.BytesIO(self.page.screenshot())) as view:
                    view.save(self._out / f"page_{name}.webp", quality=80)
            over = self.page.evaluate("document.documentElement.scrollWidth") - width
            print(f"{name}, {screen}: {max(over, 0)} pixels too wide")
        print(*self._browser.complaints, sep="\n", end="", flush=True)
        self._browser.complaints.clear()


def find_the_mount(operator: Operator, paged: Paged) -> None:
    operator.go("/setup")
    operator.page.locator(".steps .todo").first.wait_for(timeout=LONG_MS)
    operator.take("setup_todo")
    operator.go("/setup/mount")
    operator.take("mount_before")
    operator.press("Begin")
    operator.told("of 30°", "#part-mount")
    operator.take("mount_turning")
    operator.told("^Found: roll")
    operator.take("mount_found")
    operator.press("Use this mount")
    operator.page.get_by_text("These count after a restart").wait_for(timeout=LONG_MS)
    operator.take("mount_used")


def calibrate_the_lens(operator: Operator, paged: Paged) -> None:
    operator.go("/setup/lens")
    operator.take("lens_before")
    paged.camera.shown = boards()
    operator.press("Begin")
    for share in ("[1-9]", "[3-9].", "[6-9]."):
        operator.told(rf" {share}\S* % of the picture", "#part-lens")
        operator.take(f"lens_{share[1]}")
    operator.told("^Calibrated, and written to")
    operator.take("lens_done")
    operator.press("Use this calibration")
    operator.page.get_by_text("These count after a restart").wait_for(timeout=LONG_MS)
    operator.take("lens_used")
    paged.camera.shown = None


def look_around(operator: Operator, paged: Paged) -> None:
    operator.go("/setup")
    operator.take("setup")
    paged.take_off()
    operator.go("/")
    operator.told("points are tracked", "#picture-text")
    operator.take("now")
    operator.go("/map")
    operator.told("m/s", "#above-text")
    operator.take("map")
    operator.page.goto("about:blank")  # it would complain of a daemon that is away
    paged.autopilot.disarm()
    paged.daemon.line("results so far")
    paged.start_again()
    for name, path in (("flights", "/flights"), ("settings", "/settings")):
        operator.go(path)
        operator.take(name)
    operator.go("/flights")
    operator.page.locator(".flights a").first.click()
    operator.take("flight")


def write_sheet(out: Path) -> None:
    """Write the views of docs/page.md side by side, where all were taken."""
    files = [out / f"{name}_sheet.png" for name in SHEET]
    if not all(file.exists() for file in files):
        return
    width, height = SHEET_SCREEN
    sheet = Image.new("RGB", (len(files) * (width + SHEET_GAP) - SHEET_GAP, height), "white")
    for n, file in enumerate(files):
        with Image.open(file) as view:
            sheet.paste(view.convert("RGB").resize(SHEET_SCREEN), (n * (width + SHEET_GAP), 0))
    sheet.save(out / "page_views.webp", quality=80)


PARTS = {"mount": find_the_mount, "lens": calibrate_the_lens, "views": look_around}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", choices=PARTS)
    arguments = parser.parse_args()
    for name, part in PARTS.items():
        if arguments.only in (None, name):
            by_hand = {} if name == "views" else {"path": in_hands, "mounted": name == "lens"}
            with (
                tempfile.TemporaryDirectory() as folder,
                Paged(Path(folder), RATE, **by_hand) as paged,  # type: ignore[arg-type]
                Browser(*SCREENS["phone"]) as browser,
            ):
                paged.until_served()
                operator = Operator(paged, browser, arguments.out)
                operator.pair()
                part(operator, paged)
    write_sheet(arguments.out)


if __name__ == "__main__":
    main()
