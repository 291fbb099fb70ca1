"""A flight in the map that an earlier one has left, through the command line."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing, nullcontext
from dataclasses import replace
from pathlib import Path
from shutil import copy

import cv2
import numpy as np
import pytest

from companion.config import Config
from companion.estimation.gate.proof import MAP_RESUMED
from companion.estimation.localisation import LocalisationStage
from companion.estimation.site.site_use import DOUBTED, LOCATED, OTHER_CAMERA, SiteUse
from companion.geometry.transforms import Pose
from companion.messages import Frame, MapUpdate, Message, Odometry, Track, Warned
from companion.products.site_map_file import SITE_MAP, read_site_map
from companion.runtime.in_order import in_order_of_time
from companion.telemetry import AttitudeSample, PositionSample
from drivers.open_flight import open_flight
from tests.support.processes.program import Run, replay_here
from tests.support.reference.scoring import read_tum

SAMPLE = Path(__file__).parents[2] / "sample" / "survey"
CONFIG = Config()
SECOND = 1_000_000_000
BARE = ["--set", "depth.enabled=false"]


@pytest.fixture
def first(sample_begun: Run) -> Run:
    return sample_begun


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


def through(stage: LocalisationStage, messages: Iterable[Message]) -> list[Message]:
    return [out for message in messages for out in stage.step(message)]


def test_it_is_located_with_a_camera_of_fewer_pixels(first: Run) -> None:
    """Of the same flight, so that the places are known: the lens of another, and its pictures."""
    site = read_site_map(first.out / SITE_MAP).site
    flight = open_flight(SAMPLE, CONFIG.camera, CONFIG.telemetry)
    theirs = flight.camera
    width, height = round(0.8 * theirs.width), round(0.8 * theirs.height)
    x, y = width / theirs.width, height / theirs.height
    camera = replace(
        theirs, width=width, height=height, fx=theirs.fx * x, fy=theirs.fy * y,
        cx=(theirs.cx + 0.5) * x - 0.5, cy=(theirs.cy + 0.5) * y - 0.5,
    )  # fmt: skip
    begin_ns, end_ns = (flight.start_ns + s * SECOND for s in (5, 11))
    samples = [s for s in flight.telemetry().samples if isinstance(s, AttitudeSample)]
    frames = (
        replace(frame, grey=np.asarray(cv2.resize(frame.grey, (width, height)), np.uint8))
        for frame in flight.frames(begin_ns, end_ns)
        if isinstance(frame, Frame)
    )
    stage = LocalisationStage(
        CONFIG, camera, lambda _: nullcontext(), site=SiteUse(site, camera, None)
    )
    out = through(stage, in_order_of_time([s for s in samples if s.t_ns < end_ns], frames))
    said = [o.what for o in out if isinstance(o, Warned)]
    assert OTHER_CAMERA in said and LOCATED in said
    old = read_tum(first.out / "trajectory.tum")
    last = [o for o in out if isinstance(o, MapUpdate)][-1]
    assert last.georeference is not None and last.georeference.method.startswith("the map of")
    offs_m = []
    for track in (o for o in out if isinstance(o, Track) and not o.backfilled):
        relative, keyframe = track.keyframe_from_camera, track.keyframe_id
        if relative is None or keyframe is None:
            continue
        place = last.georeference.world_from_map.apply_to_pose(
            last.map_from_camera[keyframe]
            @ Pose(relative.rotation, last.scale_of.get(keyframe, 1.0) * relative.translation)
        )
        now = int(np.abs(old.t_s - track.t_ns * 1e-9).argmin())
        offs_m.append(np.linalg.norm(place.translation - old.centres[now]))
    assert len(offs_m) > 50 and np.median(offs_m) < 0.2 and max(offs_m) < 0.5


def test_satellites_that_come_30_m_away_take_its_place_from_it(first: Run) -> None:
    site = read_site_map(first.out / SITE_MAP).site
    flight = open_flight(SAMPLE, CONFIG.camera, CONFIG.telemetry)
    log = flight.telemetry()
    begin_ns, come_ns, end_ns = (flight.start_ns + s * SECOND for s in (5, 8, 13))
    samples = [s for s in log.samples if isinstance(s, AttitudeSample)] + [
        replace(s, position_ned_m=s.position_ned_m + [30.0, 0, 0])
        for s in log.samples
        if isinstance(s, PositionSample) and s.t_ns > come_ns
    ]
    messages = list(in_order_of_time(
        sorted((s for s in samples if s.t_ns < end_ns), key=lambda s: s.t_ns),
        flight.frames(begin_ns, end_ns),
    ))  # fmt: skip
    stage = LocalisationStage(
        CONFIG,
        flight.camera,
        lambda _: nullcontext(),
        site=SiteUse(site, flight.camera, log.origin),
    )
    out = through(stage, messages)
    said = [o for o in out if isinstance(o, Warned) and o.what in (LOCATED, DOUBTED)]
    assert [o.what for o in said] == [LOCATED, DOUBTED] and said[0].t_ns < come_ns
    placed = [
        (o.t_ns, o.georeference.has_origin)
        for o in out
        if isinstance(o, MapUpdate) and o.georeference is not None
    ]
    assert [has_origin for t_ns, has_origin in placed if t_ns < said[1].t_ns][-1]
    assert dict(placed)[said[1].t_ns] is False
    assert not any(has_origin for t_ns, has_origin in placed if t_ns > said[1].t_ns)
    assert len(placed) < 25, "a map is told by keyframes and seconds, not by frames"
    resets = {
        o.reset_counter for o in out if isinstance(o, Odometry) and o.t_ns > said[0].t_ns + SECOND
    }
    assert len(resets) == 1


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
