"""Place recognition: an index of binary descriptors without a trained vocabulary.

Locality-sensitive hashing (Indyk & Motwani 1998): some bits of a descriptor make a word, once for
each of several tables; keyframes that share rare words are similar, as with a bag of words.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice
from typing import NamedTuple

import numpy as np

from companion.geometry.transforms import Array
from companion.messages import Bytes
from companion.slam.compiled.word_matching import (
    Marks,
    Rows,
    Words,
    entries_of,
    equal_spans,
    marked,
    marked_spans,
    with_weights,
    words_of_bits,
)
from companion.slam.features.orb_features import Ints

N_TABLES = 8
N_BITS = 18
N_WORDS = N_TABLES << N_BITS
PLACES_VERSION = 1
"""Of the words of descriptors and the layout of a block, where these are kept."""
BLOCK, MERGED = 32, 7
"""Keyframes whose words are sorted together while more come; so many such blocks become one, as
looking for words takes about as long in a block of any size. A byte names the keyframes of one."""

_CHOSEN = np.random.default_rng(20).permutation(256)[: N_TABLES * N_BITS].reshape(N_TABLES, N_BITS)


def words_of(descriptors: Bytes) -> Words:
    """The distinct words (M,) of descriptors (N, 32), sorted."""
    return _distinct(words_of_bits(descriptors, _CHOSEN))


def _distinct(words: Words) -> Words:
    words = np.sort(words)
    return words[np.r_[True, words[1:] != words[:-1]]] if len(words) else words


class PlaceBlock(NamedTuple):
    """Words of some keyframes as `marked`, with the index in `keys` (K,) of who has each."""

    keys: Rows
    owners: Bytes
    marks: Marks
    begins: Words


def place_blocks(keyframes: Iterable[tuple[int, Bytes]]) -> Iterator[PlaceBlock]:
    """Blocks of keyframes, each a key and descriptors (N, 32), for `add_blocks`."""
    left = iter(keyframes)
    while some := list(islice(left, MERGED * BLOCK)):
        words = [words_of_bits(each, _CHOSEN) << 8 | n for n, (_, each) in enumerate(some)]
        block = _Block.merged(np.zeros(0, np.int32), np.concatenate(words, dtype=np.uint32))
        keys = np.array([key for key, _ in some], np.int32)
        yield PlaceBlock(keys, block.owners, block.marks, block.begins)


class _Block:
    """Words of some keyframes in order, and which of `rows` has each, by its index there.

    `rows` (K,) are those of the keyframes in the database, -1 where none. Of one that is merged the
    words are marked, not listed: 13 KB for 1200 features instead of 50.
    """

    def __init__(self, rows: Rows, is_merged: bool = False) -> None:
        self.rows, self.is_merged = rows, is_merged
        self.owners: Bytes = np.zeros(0, np.uint8)
        self._words: Words = np.zeros(0, np.uint32)
        self.marks, self.begins = np.zeros(0, np.uint64), np.zeros(0, np.uint32)

    @classmethod
    def merged(cls, rows: Rows, entries: Words) -> _Block:
        """The block of words of many keyframes: each shifted by a byte, which is its owner."""
        block = cls(rows, is_merged=True)
        entries = _distinct(entries)
        block.put(entries >> np.uint32(8), entries.astype(np.uint8))
        return block

    @property
    def n_keys(self) -> int:
        return int(np.count_nonzero(self.rows >= 0))

    @property
    def words(self) -> Words:
        return entries_of(self.marks) if self.is_merged else self._words

    def put(self, words: Words, owners: Bytes) -> None:
        self.owners = owners
        if self.is_merged:
            self.marks, self.begins = marked(words, N_WORDS)
        else:
            self._words = words

    def spans(self, words: Words) -> tuple[Ints, Ints]:
        if not self.is_merged:
            return equal_spans(self._words, words)
        return marked_spans(self.marks, self.begins, words)


class KeyframeDatabase:
    """Keyframes by appearance. A key is added once."""

    def __init__(self) -> None:
        self._keys: list[int] = []
        """-1 where one was removed and the row not reused"""
        self._block_of: list[_Block] = []
        self._blocks: list[_Block] = []
        self._free: list[int] = []

    def __len__(self) -> int:
        return len(self._keys) - len(self._free)

    def __contains__(self, key: int) -> bool:
        return key in self._keys

    def add(self, key: int, descriptors: Bytes) -> None:
        """Add the descriptors (N, 32) of a keyframe."""
        block = next((b for b in self._blocks if b.n_keys < BLOCK and not b.is_merged), None)
        if block is None:
            block = _Block(np.full(BLOCK, -1, np.int32))
            self._blocks.append(block)
        if self._free:
            row = self._free.pop()
            self._keys[row], self._block_of[row] = key, block
        else:
            row = len(self._keys)
            self._keys.append(key)
            self._block_of.append(block)
        owner = int(np.argmin(block.rows))
        block.rows[owner] = row
        words = words_of(descriptors)
        at = np.searchsorted(block.words, words)
        owners = np.insert(block.owners, at, np.full(len(words), owner, np.uint8))
        block.put(np.insert(block.words, at, words), owners)
        self._merge()

    def add_all(self, keyframes: Iterable[tuple[int, Bytes]]) -> None:
        """Add many keyframes, each a key and descriptors (N, 32): faster than one by one."""
        self.add_blocks(place_blocks(keyframes))

    def add_blocks(self, blocks: Iterable[PlaceBlock]) -> None:
        """Add the keyframes of blocks."""
        for each in blocks:
            rows = np.arange(len(each.keys), dtype=np.int32) + np.int32(len(self._keys))
            block = _Block(rows, is_merged=True)
            block.owners, block.marks, block.begins = each[1:]
            self._keys += each.keys.tolist()
            self._block_of += [block] * len(rows)
            self._blocks.append(block)

    def _merge(self) -> None:
        """Make one block of full ones, once there are enough; a score does not depend on it."""
        full = [b for b in self._blocks if b.n_keys == BLOCK and not b.is_merged]
        if len(full) < MERGED:
            return
        both: Words = np.concatenate(
            [b.words << 8 | (b.owners + n * BLOCK) for n, b in enumerate(full)], dtype=np.uint32
        )
        merged = _Block.merged(np.concatenate([b.rows for b in full]), both)
        self._blocks = [b for b in self._blocks if b not in full] + [merged]
        self._block_of = [merged if b in full else b for b in self._block_of]

    def remove(self, key: int) -> None:
        """Remove a keyframe."""
        row = self._keys.index(key)
        block = self._block_of[row]
        owner = int(np.flatnonzero(block.rows == row)[0])
        others = block.owners != owner
        block.put(block.words[others], block.owners[others])
        block.rows[owner] = -1
        self._keys[row] = -1
        self._free.append(row)

    def query(self, descriptors: Bytes, n: int, exclude: set[int] | None = None) -> list[int]:
        """At most `n` keys whose similarity to descriptors (N, 32) stands out, best first.

        Keys in `exclude` are left out.
        """
        keys = np.array(self._keys, np.int64)
        scores, keys = self._scores(words_of(descriptors))[keys >= 0], keys[keys >= 0]
        if not len(scores):
            return []
        usual = float(np.median(scores))
        spread = 1.4826 * float(np.median(np.abs(scores - usual)))
        order = np.argsort(-scores, kind="stable")
        stands_out = scores[order] > usual + 2.0 * spread if len(scores) > 20 else scores[order] > 0
        out: list[int] = []
        for key in keys[order[stands_out]].tolist():
            if exclude is None or key not in exclude:
                out.append(key)
            if len(out) == n:
                break
        return out

    def _scores(self, words: Words) -> Array:
        """Similarity of each row to these words, by inverse document frequency."""
        spans = [block.spans(words) for block in self._blocks]
        sizes = np.zeros(len(words), np.int64)
        for _, counts in spans:
            sizes += counts
        rarity = np.log1p(len(self) / (1.0 + sizes))
        scores = np.zeros(len(self._keys))
        for block, (begins, counts) in zip(self._blocks, spans, strict=True):
            scores = with_weights(scores, block.owners, block.rows, begins, counts, rarity)
        return scores
