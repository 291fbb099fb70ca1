"""Words of descriptors and who shares them, against the same by numpy."""

from __future__ import annotations

import numpy as np
import pytest

from companion.messages import Bytes
from companion.slam.compiled.word_matching import (
    entries_of,
    equal_spans,
    marked,
    marked_spans,
    with_weights,
)
from companion.slam.loop import place_recognition
from companion.slam.loop.place_recognition import (
    _CHOSEN,
    N_BITS,
    N_TABLES,
    KeyframeDatabase,
    words_of,
)

RANDOM = np.random.default_rng(3)


def descriptors(n: int) -> Bytes:
    return RANDOM.integers(0, 256, (n, 32), dtype=np.uint8)


def test_a_word_is_its_table_and_some_bits() -> None:
    given = descriptors(50)
    bits = np.unpackbits(given, axis=1)[:, _CHOSEN]
    wanted = bits @ (1 << np.arange(N_BITS)) + (np.arange(N_TABLES) << N_BITS)
    assert words_of(given).tolist() == np.unique(wanted).tolist()
    assert len(words_of(given[:0])) == 0


def test_spans_are_those_of_a_search() -> None:
    for n, m, most in ((0, 5, 9), (5, 0, 9), (1, 1, 2), (300, 40, 60), (300, 40, 3), (20, 400, 50)):
        among = np.sort(RANDOM.integers(0, most, n).astype(np.uint32))
        words = np.unique(RANDOM.integers(0, most, m).astype(np.uint32))
        begins, counts = equal_spans(among, words)
        assert begins.tolist() == np.searchsorted(among, words, "left").tolist()
        assert (begins + counts).tolist() == np.searchsorted(among, words, "right").tolist()


def test_spans_of_marked_entries_are_those_of_a_search() -> None:
    for n, m, most in (
        (0, 5, 64), (300, 40, 64), (900, 64, 64), (20, 400, 512), (9000, 999, 999), (999, 9, 9)
    ):  # fmt: skip
        among = np.sort(RANDOM.integers(0, most, n).astype(np.uint32))
        words = np.unique(RANDOM.integers(0, most, m).astype(np.uint32))
        marks, begins = marked(among, most)
        assert entries_of(marks).tolist() == among.tolist()
        for one, other in zip(
            marked_spans(marks, begins, words), equal_spans(among, words), strict=True
        ):
            assert one.tolist() == other.tolist()


def test_weights_go_to_owners() -> None:
    owners, rows = np.array([0, 1, 1, 2], np.uint8), np.array([0, 2, 1], np.int32)
    scores = with_weights(
        np.ones(3),
        owners,
        rows,
        np.array([0, 3]),
        np.array([3, 1]),
        np.array([0.5, 2.0]),
    )
    assert scores.tolist() == [1.5, 3.0, 2.0]


def test_the_keyframe_that_shares_words_is_found() -> None:
    database = KeyframeDatabase()
    places = [descriptors(200) for _ in range(70)]
    for key, each in enumerate(places):
        database.add(key, each)
    seen = places[41].copy()
    seen[:100] = descriptors(100)
    assert database.query(seen, 3)[:1] == [41]
    assert 41 not in database.query(seen, 3, {41})
    database.remove(41)
    assert 41 not in database.query(seen, 3)


def test_scores_do_not_depend_on_how_keyframes_are_kept_together(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(place_recognition, "BLOCK", 4)
    monkeypatch.setattr(place_recognition, "MERGED", 3)
    database = KeyframeDatabase()
    seen = descriptors(60)
    of_key = {}
    for key in range(50):
        each = np.concatenate([seen[RANDOM.random(60) < 0.2], descriptors(20)])
        database.add(key, each)
        of_key[key] = words_of(each)
        if key % 7 == 6:
            database.remove(key - 5)
            del of_key[key - 5]
    assert sum(block.is_merged for block in database._blocks) >= 2
    words = words_of(seen)
    rarity = {
        word: np.log1p(len(of_key) / (1.0 + sum(word in each for each in of_key.values())))
        for word in words.tolist()
    }
    scores = dict(zip(database._keys, database._scores(words).tolist(), strict=True))
    for key, own in of_key.items():
        shared = np.intersect1d(own, words).tolist()
        assert scores[key] == sum((rarity[word] for word in shared), 0.0)


@pytest.mark.parametrize("n", (20, 60, 250))
def test_keyframes_added_at_once_are_as_if_added_one_by_one(n: int) -> None:
    common = descriptors(40)
    keyframes = [(key, np.concatenate([descriptors(9), common[key % 30 :]])) for key in range(n)]
    at_once, one_by_one = KeyframeDatabase(), KeyframeDatabase()
    at_once.add_all(iter(keyframes))
    for key, given in keyframes:
        one_by_one.add(key, given)
    for database in (at_once, one_by_one):
        database.remove(7)
        database.add(900, common)
    assert len(at_once) == n and 7 not in at_once
    words = words_of(np.concatenate([common[25:], keyframes[3][1]]))
    scores = at_once._scores(words)
    assert scores.max() > 0 and np.array_equal(scores, one_by_one._scores(words))
    assert at_once.query(common, n) == one_by_one.query(common, n)
