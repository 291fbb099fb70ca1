from __future__ import annotations

import numpy as np

from companion.messages import Frame, KeyframeAdded, MapUpdate, Track, TrackState
from companion.topics.backlog import Backlog
from companion.topics.envelope import unpack
from companion.topics.gatherer import Gatherer
from companion.topics.keyframe_bundle import Bundle, bundle_of
from tests.support.flights import topic_flight


def fetched(
    backlog: Backlog, run: str, number: int, now_s: float, whole: bool = False
) -> Bundle | None:
    envelope = unpack(backlog.after(run, number, now_s, whole))
    return bundle_of(envelope) if envelope.kind == "bundle" else None


def filled(capacity_bytes: int = 1 << 26, budget_bytes_s: float = 0.0) -> Backlog:
    backlog = Backlog("run", capacity_bytes, budget_bytes_s)
    for bundle in topic_flight.bundles(60):
        backlog.put(bundle, topic_flight.update(59))
    return backlog


def test_only_keyframes_are_in_colour_and_only_what_has_moved_is_taken() -> None:
    bundles = topic_flight.bundles(31)
    pictures = [p for bundle in bundles for p in bundle.pictures]
    assert [p.seq for p in pictures] == list(range(31))
    assert [p.seq for p in pictures if p.in_colour] == [0, 6, 12, 18, 24, 30]
    gatherer = Gatherer("run", 0.0, 90)
    picture = topic_flight.wall()
    for seq in range(10):  # it stands still
        gatherer.take(topic_flight.frame(seq, picture))
        here = topic_flight.pose(0)
        gatherer.take(Track(seq, seq, TrackState.TRACKING, here, 0, here))
    gatherer.take(KeyframeAdded(0, 9, 9, topic_flight.pose(0), topic_flight.points()))
    bundle = gatherer.take(topic_flight.update(0))
    assert bundle is not None and [p.seq for p in bundle.pictures] == [0, 9]
    assert gatherer.n_dropped == 0 and len(bundle.tracks) == 10


def test_less_is_sent_than_the_budget_allows_and_what_is_left_out_is_counted() -> None:
    wanted = sum(len(p.jpeg) for b in topic_flight.bundles(240) for p in b.pictures)
    budget_bytes_s = 0.4 * wanted / 24.0
    gatherer = Gatherer("run", budget_bytes_s, 90)
    sent, full = 0, 0
    for message in topic_flight.messages(240):
        if isinstance(message, (Frame, Track, KeyframeAdded, MapUpdate)):
            bundle = gatherer.take(message)
            if bundle is not None:
                sent += sum(len(p.jpeg) for p in bundle.pictures)
                full += len(bundle.pictures) >= 5
    assert sent < budget_bytes_s * (24.0 + 3.5)
    assert gatherer.n_dropped > 60
    assert full > 5  # those that are sent have what depth needs


def test_frames_that_nobody_places_do_not_pile_up() -> None:
    gatherer = Gatherer("run", 0.0, 90)
    image = np.zeros((96, 128), np.uint8)
    for seq in range(600):
        gatherer.take(Frame(seq, seq, image, np.zeros((96, 128, 3), np.uint8)))
    gatherer.take(KeyframeAdded(0, 599, 599, topic_flight.pose(0), topic_flight.points()))
    bundle = gatherer.take(topic_flight.update(0))
    assert bundle is not None and [p.seq for p in bundle.pictures] == [599]


def test_whoever_comes_gets_all_that_is_there_in_order() -> None:
    backlog = filled()
    number, seen = -1, []
    while (bundle := fetched(backlog, "run", number, 1.0)) is not None:
        number = bundle.number
        seen.append(number)
    assert seen == list(range(11)) and bundle_is_last(backlog)
    assert fetched(backlog, "another run", 7, 1.0).number == 0  # type: ignore[union-attr]


def bundle_is_last(backlog: Backlog) -> bool:
    last = fetched(backlog, "run", 9, 1.0)
    return last is not None and last.over


def test_who_begins_anew_gets_the_whole_map_first() -> None:
    backlog = filled()
    first = fetched(backlog, "run", 4, 1.0, whole=True)
    assert first is not None and first.number == 4 and first.change is not None
    assert first.change.whole and len(first.change.update.map_from_camera) == 10
    second = fetched(backlog, "run", 4, 1.0)
    assert second is not None and second.number == 5 and len(second.pictures) == 6


def test_the_oldest_give_way_and_are_counted() -> None:
    backlog = filled(capacity_bytes=100_000)
    assert backlog.n_evicted > 2
    first = fetched(backlog, "run", -1, 1.0)
    assert first is not None and first.change is not None and first.change.whole
    following = fetched(backlog, "run", first.number, 1.0)
    assert following is not None and following.number == first.number + 1
    assert following.number == backlog.n_evicted


def test_no_more_is_given_than_the_budget_allows() -> None:
    backlog = filled(budget_bytes_s=20_000)
    number, n_bytes, now_s = -1, 0, 0.0
    while now_s < 5.0:
        now_s += 0.05
        data = backlog.after("run", number, now_s)
        if unpack(data).kind == "bundle":
            n_bytes += len(data)
            number = bundle_of(unpack(data)).number
    assert 0 < number < 10
    assert n_bytes < 20_000 * (5.0 + 2.0) + 40_000
