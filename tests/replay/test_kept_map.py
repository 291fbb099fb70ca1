"""A flight in the map that an earlier one has left, through the command line."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, nullcontext
from pathlib import Path
from shutil import copy

import numpy as np
import pytest

from companion.config import Config
from companion.estimation.localisation import LocalisationStage
from companion.estimation.map_resumption import MAP_RESUMED
from companion.estimation.site.site_use import LOCATED, SiteUse
from companion.messages import Frame, Message, Warned
from companion.products.site_map_file import SITE_MAP, read_site_map
from companion.runtime.in_order import in_order_of_time
from companion.telemetry import AttitudeSample
from drivers.open_flight import open_flight
from tests.support.processes.program import Run, replay_here
from tests.support.reference.scoring import read_tum

SAMPLE = Path(__file__).parents[2] / "sample" / "survey"
CONFIG = Config()
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


def test_a_flight_taken_up_after_a_restart_is_located_in_it_again(first: Run) -> None:
    site = read_site_map(first.out / SITE_MAP).site
    flight = open_flight(SAMPLE, CONFIG.camera, CONFIG.telemetry)
    samples = [s for s in flight.telemetry().samples if isinstance(s, AttitudeSample)]

    def flown(begin_s: float, end_s: float) -> Iterator[Message]:
        begin_ns, end_ns = (flight.start_ns + round(s * 1e9) for s in (begin_s, end_s))
        own = [s for s in samples if begin_ns - 1e9 < s.t_ns < end_ns]
        return in_order_of_time(own, flight.frames(begin_ns, end_ns))

    def stage() -> LocalisationStage:
        use = SiteUse(site, flight.camera, None)
        return LocalisationStage(CONFIG, flight.camera, lambda _: nullcontext(), site=use)

    before = stage()
    said = [o.what for m in flown(5, 8) for o in before.step(m) if isinstance(o, Warned)]
    assert LOCATED in said
    kept = before.checkpoint()
    assert kept is not None
    after, again = stage(), list[str]()
    for message in flown(7, 11):
        if isinstance(message, Frame) and not again:
            after.resume(kept, message.t_ns, 1_000_000_000)
            again.append("resumed")
        again += [o.what for o in after.step(message) if isinstance(o, Warned)]
    assert MAP_RESUMED in again and LOCATED in again
    left = after.site_map("after", None)
    assert left is not None
    assert len(left.parts) == len(site.parts) + 1 and len(left.keyframes) > len(site.keyframes)
    assert min(k.t_ns for k in left.keyframes) > 0
