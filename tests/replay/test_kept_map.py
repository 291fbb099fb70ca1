"""A flight in the map that an earlier one has left, through the command line."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from shutil import copy

import numpy as np
import pytest

from companion.products.site_map_file import SITE_MAP, read_site_map
from tests.support.processes.program import Run, replay_here
from tests.support.reference.scoring import read_tum

SAMPLE = Path(__file__).parents[2] / "sample" / "survey"
BARE = ["--set", "depth.enabled=false"]


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Run:
    done = replay_here(SAMPLE, tmp_path_factory.mktemp("first"), "--stop", "14", *BARE)
    assert done.status == 0, done.stderr
    return done


def test_it_goes_on_in_the_map_without_satellites(first: Run, tmp_path: Path) -> None:
    again = replay_here(
        SAMPLE, tmp_path, "--start", "5", "--stop", "11", "--map", str(first.out),
        "--set", 'telemetry.use=["attitude"]', *BARE,
    )  # fmt: skip
    assert again.status == 0, again.stderr
    old, new = read_tum(first.out / "trajectory.tum"), read_tum(tmp_path / "trajectory.tum")
    rows = np.searchsorted(old.t_s, new.t_s - 1e-4)
    off_m = np.linalg.norm(new.centres - old.centres[rows], axis=1)
    assert len(new.t_s) > 50 and np.median(off_m) < 0.1 and off_m.max() < 0.5
    report = again.report
    assert report["unit"] == "m" and report["origin"] is not None
    site = read_site_map(tmp_path / SITE_MAP).site
    assert site.revision == 2 and len(site.parts) == 2


def test_a_map_from_a_newer_version_ends_a_replay(first: Run, tmp_path: Path) -> None:
    newer = tmp_path / "newer.map"
    copy(first.out / SITE_MAP, newer)
    with closing(sqlite3.connect(newer)) as file:
        file.execute("PRAGMA user_version = 99")
    done = replay_here(SAMPLE, tmp_path / "out", "--map", str(newer), *BARE)
    assert done.status == 2 and "version 99" in done.stderr
