from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from companion.geometry.transforms import Pose, Similarity
from companion.messages import PointChunk
from companion.streaming.item_store import ItemStore
from companion.streaming.items import (
    COARSE,
    FINE,
    FlightItem,
    ImageItem,
    Item,
    LogItem,
    PathItem,
    PictureItem,
    PlacesItem,
    PointsItem,
    PoseItem,
    Shown,
    StatusItem,
)
from companion.streaming.parts import Part, parts_of
from companion.streaming.session import Session
from tests.support.flights import flown
from tests.support.processes.thin_link import ThinLink
from tests.unit.streaming.test_viewer_recording import CAMERA

ROOM = 64 << 20
NOISE = np.random.default_rng(1).integers(0, 255, (480, 640, 3)).astype(np.uint8)
SMOOTH = np.repeat(np.repeat(NOISE[::40, ::40], 40, 0), 40, 1)
POSE_EVERY_S, IMAGE_EVERY_S, CHUNK_EVERY_S = 1 / 30, 0.1, 1.0


def points(keyframe_id: int, n: int = 5000) -> PointsItem:
    chunk: PointChunk = flown.chunk(keyframe_id % 12, n)
    return PointsItem(chunk.t_ns, keyframe_id, "", chunk.points_camera, chunk.rgb, chunk.confidence)


CHUNKS = [points(k) for k in range(12)]
PARTS = [parts_of(chunk) for chunk in CHUNKS]


def take(store: ItemStore, item: Item) -> None:
    store.put(item, parts_of(item))


def filled(n_keyframes: int) -> ItemStore:
    """A store with a map of so many keyframes."""
    store = ItemStore(ROOM)
    take(store, FlightItem("a", "flight", CAMERA))
    for k in range(n_keyframes):
        place(store, k)
        add_points(store, k)
    return store


def add_points(store: ItemStore, k: int) -> None:
    """One of a few known chunks under another keyframe's number."""
    parts = [
        Part(kind, k, payload[:8] + k.to_bytes(4, "little") + payload[12:])
        for kind, _, payload in PARTS[k % 12]
    ]
    store.put(CHUNKS[k % 12], parts)


def place(store: ItemStore, k: int, shift: float = 0.0) -> None:
    where = Similarity(1.0, np.eye(3), np.array([k + shift, 0.0, 0.0]))
    take(store, PlacesItem(k, {k: where}))


def flying(store: ItemStore) -> Callable[[float], None]:
    """A flight goes on in a store: poses, frames and points by simulated time."""
    due = dict.fromkeys(("pose", "image", "points", "status"), 0.0)
    n = [10_000]

    def each(now_s: float) -> None:
        def is_due(what: str, every_s: float) -> bool:
            if now_s < due[what]:
                return False
            due[what] += every_s
            return True

        t_ns = int(now_s * 1e9)
        if is_due("pose", POSE_EVERY_S):
            take(store, PoseItem(t_ns, Shown.TRACKING, Pose.identity(), 100, 80, 12.0, 3.0))
        if is_due("image", IMAGE_EVERY_S):
            take(store, ImageItem(t_ns, SMOOTH))
        if is_due("status", 1.0):
            take(store, StatusItem(t_ns, {"state": "Tracking", "rate_hz": 30.0}))
        if is_due("points", CHUNK_EVERY_S):
            n[0] += 1
            place(store, n[0])
            add_points(store, n[0])

    return each


def ages_s(link: ThinLink, since_s: float) -> np.ndarray:
    """How old what was on screen was, over time: sampled every 10 ms."""
    seen = [(at, item.t_ns * 1e-9) for at, item in link.arrived if isinstance(item, PoseItem)]
    times = np.array([at for at, _ in seen])
    samples = np.arange(since_s, link.now_s, 0.01)
    newest = np.searchsorted(times, samples, side="right") - 1
    assert newest.min() >= 0, "no pose in time"
    ages: np.ndarray = samples - np.array([t for _, t in seen])[newest]
    return ages


@pytest.mark.parametrize(
    "kbit_s, delay_s, budget, p95_s",
    [(20_000, 0.01, 0, 0.15), (2_000, 0.06, 0, 0.35), (500, 0.15, 0, 0.6), (500, 0.15, 300, 0.6),
     (150, 0.3, 0, 1.5)],
)  # fmt: skip
def test_the_pose_stays_fresh_and_the_coarse_map_grows(
    kbit_s: float, delay_s: float, budget: float, p95_s: float
) -> None:
    store = filled(0)
    link = ThinLink(Session(store), kbit_s * 125, delay_s, budget)
    link.run(30.0, flying(store))
    assert np.percentile(ages_s(link, 5.0), 95) < p95_s
    coarse = [at for at, i in link.arrived if isinstance(i, PointsItem) and i.level == COARSE]
    assert np.diff([5.0, *(at for at in coarse if at > 5), 30.0]).max() < (4 if kbit_s > 150 else 8)
    assert any(isinstance(item, PictureItem) for _, item in link.arrived)
    assert link.n_sent / 30 <= 1.1 * 125 * (budget or kbit_s)
    if kbit_s >= 20_000:
        fine = [i.keyframe_id for _, i in link.arrived
                if isinstance(i, PointsItem) and i.level == FINE]  # fmt: skip
        assert len(fine) >= 28
        pictures = [i for _, i in link.arrived if isinstance(i, PictureItem)]
        assert len(pictures) > 200 and pictures[-1].width == 640


def test_the_link_is_used_and_no_queue_grows_in_it() -> None:
    store = filled(300)
    link = ThinLink(Session(store), 100_000, 0.03)
    each = flying(store)
    link.run(10.0, each)
    assert link.n_sent > 0.8 * 10 * 100_000
    link.most_queued_s = 0.0
    link.run(10.0, each)
    assert link.most_queued_s < 0.2


def test_who_comes_late_gets_the_whole_coarse_map_first_and_the_newest_of_it_first() -> None:
    store = filled(480)
    link = ThinLink(Session(store), 2_500_000, 0.01)
    link.run(5.0, flying(store))
    order = [i for _, i in link.arrived if isinstance(i, PointsItem)]
    levels = [i.level for i in order]
    assert levels.count(COARSE) >= 480
    held = [i.keyframe_id for i in order if i.keyframe_id < 480][:400]
    assert held == sorted(held, reverse=True)
    first_fine = levels.index(FINE)
    assert levels[:first_fine].count(COARSE) >= 470


def test_a_loop_closure_sends_places_and_no_points() -> None:
    store = filled(100)
    link = ThinLink(Session(store), 2_500_000, 0.01)
    link.run(5.0)
    link.arrived.clear()
    link.n_sent = 0
    for k in range(100):
        place(store, k, 0.5)
    link.run(1.0)
    moved = [i for _, i in link.arrived]
    assert {type(i) for i in moved} == {PlacesItem}
    assert sum(len(i.places) for i in moved if isinstance(i, PlacesItem)) == 100
    assert link.n_sent < 5000


def test_after_an_outage_the_newest_comes_at_once_and_nothing_is_missing() -> None:
    store = filled(0)
    link = ThinLink(Session(store), 250_000, 0.03)
    each = flying(store)
    link.run(20.0, each)
    link.is_up = False
    link.run(30.0, each)
    link.is_up = True
    link.reconnect()
    link.run(2.0, each)
    fresh = [i for at, i in link.arrived if at > 50 and isinstance(i, PoseItem)]
    assert fresh[0].t_ns * 1e-9 > 49.9
    link.run(8.0, each)
    coarse = {i.keyframe_id for _, i in link.arrived
              if isinstance(i, PointsItem) and i.level == COARSE}  # fmt: skip
    assert len(coarse) >= 58


def test_items_in_flight_on_a_lost_connection_are_sent_on_the_next() -> None:
    store = filled(20)
    link = ThinLink(Session(store), 62_500, 0.15)
    link.run(1.0)
    link.reconnect()
    link.run(30.0)
    got = {(i.keyframe_id, i.level) for _, i in link.arrived if isinstance(i, PointsItem)}
    assert got == {(k, level) for k in range(20) for level in (COARSE, FINE)}
    assert link.session.is_complete


def test_a_viewer_that_takes_nothing_is_sent_little_and_makes_nothing_grow() -> None:
    store = filled(0)
    session = Session(store)
    link = ThinLink(session, 2_500_000, 0.01)
    each = flying(store)
    link.run(5.0, each)
    link.viewer_takes = False
    link.run(1.0, each)
    sent, waiting = link.n_sent, session.n_waiting
    link.run(59.0, each)
    assert link.n_sent == sent
    assert session.n_waiting < waiting + 5 * 60
    assert session.n_skipped["poses"] > 1000 and session.n_skipped["pictures"] > 300
    link.viewer_takes = True
    link.run(1.0, each)
    assert ages_s(link, link.now_s - 0.2).max() < 0.3


def test_the_store_is_bounded_and_gives_up_the_finest_of_the_oldest() -> None:
    one = ItemStore(ROOM)
    take(one, CHUNKS[0])
    store = ItemStore(16 * one.points_bytes)
    for k in range(30):
        add_points(store, k)
    for n in range(500):
        take(store, LogItem(n, "said"))
    assert store.points_bytes <= 16 * one.points_bytes
    assert store.n_evicted["fine"] > 15 and store.n_evicted["coarse"] == 0
    assert store.n_evicted["log"] == 300
    link = ThinLink(Session(store), 2_500_000, 0.01)
    link.run(10.0)
    items = [i for _, i in link.arrived]
    fine = [i.keyframe_id for i in items if isinstance(i, PointsItem) and i.level == FINE]
    coarse = [i.keyframe_id for i in items if isinstance(i, PointsItem) and i.level == COARSE]
    assert sorted(coarse) == list(range(30)) and min(fine) > 10
    assert [i.t_ns for i in items if isinstance(i, LogItem)] == list(range(300, 500))


def test_a_viewer_learns_what_its_link_does() -> None:
    store = filled(50)
    link = ThinLink(Session(store), 62_500, 0.15, budget_kbit_s=400)
    link.run(10.0, flying(store))
    facts = [i.facts for _, i in link.arrived if isinstance(i, StatusItem)][-1]
    assert 200 < facts["link_kbit_s"] < 420
    assert 290 < facts["round_trip_ms"] < 700
    assert facts["budget_kbit_s"] == 400 and facts["waiting"] > 10
    assert facts["skipped"]["poses"] >= 0 and facts["state"] == "Tracking"


def test_levels_together_are_all_points_and_a_path_is_what_it_was() -> None:
    store = filled(1)
    strip = np.array([[0, 0, 0], [1, 2, 3.5]], np.float32)
    take(store, PathItem(5, 7, 0, strip))
    link = ThinLink(Session(store), 2_500_000, 0.01)
    link.run(2.0)
    items = [i for _, i in link.arrived]
    assert sum(len(i.points_camera) for i in items if isinstance(i, PointsItem)) == 5000
    (path,) = [i for i in items if isinstance(i, PathItem)]
    assert (path.t_ns, path.piece, path.keyframe_id) == (5, 7, 0)
    assert np.array_equal(path.strip, strip)
