"""Words of binary descriptors, and who shares them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array
from companion.messages import Bytes
from companion.slam.compiled.compiling import (
    Ints,
    compiled,
    given,
    half_word,
    images,
    integer,
    integers,
    large_word,
    numbers,
    part,
    small_integer,
    tiny_word,
)

Words = NDArray[np.uint32]
Rows = NDArray[np.int32]
Marks = NDArray[np.uint64]
words_given, bytes_given = given(half_word, 1), given(tiny_word, 1)
STRIDE = 64
"""Words between two of which it is known how many entries are before them."""
_PAIRS, _FOURS = np.uint64(0x5555555555555555), np.uint64(0x3333333333333333)
_EIGHTS, _SUM = np.uint64(0x0F0F0F0F0F0F0F0F), np.uint64(0x0101010101010101)
_1, _2, _4, _56, _ALL = (np.uint64(each) for each in (1, 2, 4, 56, 0xFFFFFFFFFFFFFFFF))


@compiled(images, given(integer, 2))
def words_of_bits(descriptors: Bytes, bits: Ints) -> Words:
    """Words (N * T,) of descriptors (N, 32): the bits (T, B) of each table, after its number."""
    n, (n_tables, n_bits) = len(descriptors), bits.shape
    out = np.empty(n * n_tables, np.uint32)
    for i in range(n):
        for table in range(n_tables):
            word = table << n_bits
            for k in range(n_bits):
                bit = bits[table, k]
                word |= ((descriptors[i, bit >> 3] >> (7 - (bit & 7))) & 1) << k
            out[i * n_tables + table] = word
    return out


@compiled(words_given, words_given)
def equal_spans(among: Words, words: Words) -> tuple[Ints, Ints]:
    """Index of each of `words` (M,) among others, and how often it is there; both sorted."""
    n, m = len(among), len(words)
    begins, counts = np.empty(m, np.int64), np.empty(m, np.int64)
    at = 0
    for i in range(m):
        word = words[i]
        step, low = 1, at  # words lie close to each other: the next is looked for from here on
        while at < n and among[at] < word:
            low = at + 1
            at += step
            step *= 2
        high = min(at, n)
        while low < high:
            middle = (low + high) // 2
            if among[middle] < word:
                low = middle + 1
            else:
                high = middle
        at = low
        while at < n and among[at] == word:
            at += 1
        begins[i], counts[i] = low, at - low
    return begins, counts


def marked(entries: Words, n_words: int) -> tuple[Marks, Words]:
    """Sorted entries, words below a number, by two bits each, more or less.

    Of each word as many zeros as it has entries, then a one; and the indices of the first entries
    of each STRIDE-th word.
    """
    up_to = np.cumsum(np.bincount(entries, minlength=n_words))
    bits = np.zeros(-(-(n_words + len(entries)) // 64) * 64, bool)
    bits[up_to + np.arange(n_words)] = True
    return (
        np.packbits(bits, bitorder="little").view(np.uint64),
        np.r_[0, up_to[STRIDE - 1 :: STRIDE]].astype(np.uint32),
    )


def entries_of(marks: Marks) -> Words:
    """The entries that were marked."""
    ends = np.flatnonzero(np.unpackbits(marks.view(np.uint8), bitorder="little"))
    return np.repeat(np.arange(len(ends), dtype=np.uint32), np.diff(ends, prepend=-1) - 1)


@part
def _ones(x: np.uint64) -> int:
    x = x - ((x >> _1) & _PAIRS)
    x = (x & _FOURS) + ((x >> _2) & _FOURS)
    return int((((x + (x >> _4)) & _EIGHTS) * _SUM) >> _56)


@compiled(given(large_word, 1), words_given, words_given)
def marked_spans(marks: Marks, begins: Words, words: Words) -> tuple[Ints, Ints]:
    """As `equal_spans` of entries that are `marked`."""
    first, n = np.empty(len(words), np.int64), np.empty(len(words), np.int64)
    for i in range(len(words)):
        word = np.int64(words[i])
        left = word % STRIDE
        begin = np.int64(begins[word // STRIDE]) + word - left
        k = begin >> 6
        bits = marks[k] & (_ALL << np.uint64(begin & 63))
        if left:
            n_here = _ones(bits)
            while n_here < left:
                left -= n_here
                k += 1
                bits = marks[k]
                n_here = _ones(bits)
            for _ in range(left - 1):
                bits &= bits - _1
            begin = 64 * k + _ones(bits ^ (bits - _1))
            bits &= bits - _1
        while bits == 0:
            k += 1
            bits = marks[k]
        first[i], n[i] = begin - word, 64 * k + _ones(bits ^ (bits - _1)) - 1 - begin
    return first, n


@compiled(numbers, bytes_given, given(small_integer, 1), integers, integers, numbers)
def with_weights(
    scores: Array, owners: Bytes, rows: Rows, begins: Ints, counts: Ints, weights: Array
) -> Array:
    """Scores with the weight of each word added to each of its owners, which are some `rows`."""
    out = scores.copy()
    for i in range(len(begins)):
        for j in range(begins[i], begins[i] + counts[i]):
            out[rows[owners[j]]] += weights[i]
    return out
