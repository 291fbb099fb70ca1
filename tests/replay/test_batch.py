import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from companion.geometry.transforms import Similarity
from companion.products.site_map_file import SITE_MAP, read_site_map, write_site_map
from companion.slam.map.site_map import SiteGeoreference, SitePart, site_map_of
from tests.support.flights.recorded import record
from tests.support.reference.synthetic_map import CAMERA, Ground, flown, mapped

pytest.importorskip("distributed")
FIRST, SECOND, THIRD = (f"2026-01-0{day}T00-00-00Z" for day in (1, 2, 3))


IMPATIENT = """
import sys
from companion.app import batch_command
from companion.app.cli import main
batch_command.CONNECT = "0.5s"
sys.exit(main(sys.argv[1:]))
"""


def batch(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "companion", "batch", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=280, check=False)


def test_an_archive_is_replayed_once_merged_and_shown_on_one_page(tmp_path: Path) -> None:
    record(tmp_path / FIRST, 12)
    record(tmp_path / SECOND, 12, "raw")
    record(tmp_path / THIRD, 12)
    (tmp_path / "empty").mkdir()
    record(tmp_path / "short", 2)
    flights = [tmp_path / FIRST, tmp_path / SECOND / "flight.mcap", tmp_path / THIRD]
    flights += [tmp_path / "empty", tmp_path / "short"]
    out = tmp_path / "out"
    settings = "--out", out, "--set", "depth.enabled=false"
    done = batch(*flights, *settings, "--workers", 2)
    assert done.returncode == 1
    lines = done.stderr.splitlines()
    assert len(lines) == 2 and lines[0].startswith("companion: empty: "), done.stderr
    assert lines[1].startswith("companion: short: no map: "), done.stderr
    assert "5 flights, 0 done before, 2 failed" in done.stdout
    for name in (FIRST, SECOND, THIRD):
        assert json.loads((out / name / "report.json").read_text())["frames"] == 12
    page = (out / "index.html").read_text()
    assert page.count("data:image/jpeg;base64,") == 3
    assert f'href="{FIRST}/report.html"' in page and "no video and no images" in page
    assert 'href="short/report.html"' in page and (out / "short" / "report.html").is_file()
    assert 'href="empty/' not in page

    def stamps() -> list[int]:
        return [(out / name / "report.json").stat().st_mtime_ns for name in (FIRST, SECOND, THIRD)]

    before = stamps()
    record(tmp_path / "other" / THIRD, 10)
    (tmp_path / "other" / THIRD / "flight.mcap").replace(tmp_path / THIRD / "flight.mcap")
    ground = Ground(np.random.default_rng(5))
    for n, name in enumerate((FIRST, SECOND)):
        path = [flown(p, 2.6 * n) for p in np.linspace((-5, n), (5, -n), 9)]
        made = mapped(ground, path, Similarity.identity())
        part, placed = SitePart(name, 0, CAMERA, 1), SiteGeoreference(None, 1.0, 0.02, 0.01, "gps")
        site = site_map_of(made, Similarity.identity(), (part,), {}, placed, 1)
        write_site_map(out / name / SITE_MAP, site)
    done = batch(*flights[:3], *settings, "--merge")
    assert done.returncode == 0, done.stderr
    assert "3 flights, 2 done before, 0 failed" in done.stdout
    again = stamps()
    assert again[:2] == before[:2] and again[2] > before[2]
    assert json.loads((out / THIRD / "report.json").read_text())["frames"] == 10
    assert f"site.map: {FIRST}, {SECOND}" in done.stdout
    assert len(read_site_map(out / SITE_MAP).site.keyframes) == 18
    assert "of these also seen by others" in (out / "index.html").read_text()


def test_a_cluster_that_is_not_there_is_named(tmp_path: Path) -> None:
    record(tmp_path / FIRST, 3)
    words = [tmp_path / FIRST, "--out", tmp_path / "out", "--scheduler", "tcp://127.0.0.1:1"]
    command = [sys.executable, "-c", IMPATIENT, "batch", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=280, check=False)
    assert done.returncode == 2
    assert "tcp://127.0.0.1:1: there is no Dask scheduler" in done.stderr
