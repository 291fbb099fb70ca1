"""Frames a second of the report's view in 3-D, drawn by software in Chromium; for results.md.

    python -m tests.bench.report_view REPORT.html

The view is turned in each frame for five seconds: as it is used, where it draws as many points as
it manages in a thirtieth of a second, and with all points in each frame.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from playwright.sync_api import sync_playwright

from tests.unit.products.test_cloud_scene import CHROMIUM, DRAWN, OPTIONS

TURN = """async (all) => {
  const view = document.getElementById("scene").view;
  if (all) { view.adapt = () => {}; view.budget = view.facts.n; }
  const begin = performance.now() + 2000, end = begin + 5000;
  let frames = 0, points = 0;
  await new Promise((done) => {
    function turn(now) {
      view.camera.turn(0.01, 0);
      view.redraw(true);
      if (now > begin) { frames++; points += view.budget; }
      if (now < end) requestAnimationFrame(turn); else done();
    }
    requestAnimationFrame(turn);
  });
  return [frames / 5, points / frames, view.canvas.width, view.canvas.height];
}"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("report", type=Path)
    report = parser.parse_args().report
    with sync_playwright() as tools:
        browser = tools.chromium.launch(executable_path=CHROMIUM, args=[*OPTIONS, *DRAWN])
        page = browser.new_page(viewport={"width": 1240, "height": 900})
        page.goto(report.resolve().as_uri())
        page.wait_for_function("document.getElementById('scene').view?.matrix")
        for all_points, what in ((False, "as used"), (True, "all points")):
            rate, points, width, height = page.evaluate(TURN, all_points)
            print(f"{what}: {rate:.1f} frames/s, {points:.0f} points, {width} x {height} px")
        browser.close()


if __name__ == "__main__":
    main()
