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
    numbers,
    small_integer,
    tiny_word,
)

Words = NDArray[np.uint32]
Rows = NDArray[np.int32]
words_given, bytes_given = given(half_word, 1), given(tiny_word, 1)
STRIDE = 16
"""Words between two of which it is known how many entries are before them."""


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


@compiled(bytes_given, words_given, words_given)
def counted_spans(counts: Bytes, begins: Words, words: Words) -> tuple[Ints, Ints]:
    """As `equal_spans` of entries of which is known how many have each word.

    `begins` are the indices of the first entries of each STRIDE-th word.
    """
    first, n = np.empty(len(words), np.int64), np.empty(len(words), np.int64)
    for i in range(len(words)):
        word = np.int64(words[i])
        at = np.int64(begins[word // STRIDE])
        for before in range(word - word % STRIDE, word):
            at += counts[before]
        first[i], n[i] = at, counts[word]
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
