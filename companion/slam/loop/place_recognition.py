"""Place recognition: an index of binary descriptors without a trained vocabulary.

Locality-sensitive hashing (Indyk & Motwani 1998): some bits of a descriptor make a word, once for
each of several tables; keyframes that share rare words are similar, as with a bag of words.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from companion.geometry.transforms import Array
from companion.messages import Bytes
from companion.slam.compiled.word_matching import (
    Rows,
    Words,
    equal_spans,
    with_weights,
    words_of_bits,
)

N_TABLES = 8
N_BITS = 18
BLOCK, MERGED = 32, 8
"""Keyframes whose words are sorted together while more come; so many such blocks become one, as
looking for words takes about as long in a block of any size."""

_CHOSEN = np.random.default_rng(20).permutation(256)[: N_TABLES * N_BITS].reshape(N_TABLES, N_BITS)


def words_of(descriptors: Bytes) -> Words:
    """The distinct words (M,) of descriptors (N, 32), sorted."""
    words = np.sort(words_of_bits(descriptors, _CHOSEN))
    return words[np.r_[True, words[1:] != words[:-1]]] if len(words) else words


@dataclass(slots=True, eq=False)
class _Block:
    """Sorted words of some keyframes, and the row in `keys` of the keyframe of each."""

    words: Words = field(default_factory=lambda: np.zeros(0, np.uint32))
    owners: Rows = field(default_factory=lambda: np.zeros(0, np.int32))
    n_keys: int = 0
    is_merged: bool = False


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
            block = _Block()
            self._blocks.append(block)
        if self._free:
            row = self._free.pop()
            self._keys[row], self._block_of[row] = key, block
        else:
            row = len(self._keys)
            self._keys.append(key)
            self._block_of.append(block)
        words = words_of(descriptors)
        at = np.searchsorted(block.words, words)
        block.words = np.insert(block.words, at, words)
        block.owners = np.insert(block.owners, at, np.full(len(words), row, np.int32))
        block.n_keys += 1
        self._merge()

    def _merge(self) -> None:
        """Make one block of full ones, once there are enough; a score does not depend on it."""
        full = [b for b in self._blocks if b.n_keys == BLOCK and not b.is_merged]
        if len(full) < MERGED:
            return
        words = np.concatenate([b.words for b in full]).astype(np.int64)
        both = np.sort(words << 32 | np.concatenate([b.owners for b in full]))
        merged = _Block(
            (both >> 32).astype(np.uint32), both.astype(np.int32), BLOCK * MERGED, is_merged=True
        )
        gone = set(map(id, full))
        self._blocks = [b for b in self._blocks if id(b) not in gone] + [merged]
        self._block_of = [merged if id(b) in gone else b for b in self._block_of]

    def remove(self, key: int) -> None:
        """Remove a keyframe."""
        row = self._keys.index(key)
        block = self._block_of[row]
        others = block.owners != row
        block.words, block.owners = block.words[others], block.owners[others]
        block.n_keys -= 1
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
        spans = [equal_spans(block.words, words) for block in self._blocks]
        sizes = np.zeros(len(words), np.int64)
        for _, counts in spans:
            sizes += counts
        rarity = np.log1p(len(self) / (1.0 + sizes))
        scores = np.zeros(len(self._keys))
        for block, (begins, counts) in zip(self._blocks, spans, strict=True):
            scores = with_weights(scores, block.owners, begins, counts, rarity)
        return scores
