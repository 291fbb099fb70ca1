"""GPMF, the metadata that GoPro cameras write into their videos: nested key, length, value.

The format is public (github.com/gopro/gpmf-parser, docs): a key of four letters, a letter for the
type, a byte for the size of one element and two for their count, then the elements, padded to four
bytes. Type 0 holds further keys. In a stream (STRM) SCAL divides what follows it, TYPE gives the
letters of elements made of several types ("?"), STNM its name, ORIN the axes of its fields. Streams
with text in their elements, such as the scenes that later cameras recognise, are passed over.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array

LETTERS = {
    "b": "b", "B": "B", "s": "h", "S": "H", "l": "i", "L": "I", "j": "q", "J": "Q",
    "f": "f", "d": "d", "q": "i", "Q": "q",
}  # fmt: skip
FIXED_POINT = {"q": 2.0**-16, "Q": 2.0**-32}
TEXT = frozenset("cFGU")


@dataclass(frozen=True, slots=True, eq=False)
class GpmfStream:
    """Samples of one stream in one payload: rows (N, fields), in the units that it states."""

    key: str
    rows: Array
    name: str = ""
    """Name in the stream."""
    orientation: str = ""
    """A letter for the axis of each field, lower case if it points the other way; "" if unknown."""


class GpmfError(ValueError):
    """Payload that violates the format."""


def read_streams(payload: bytes) -> list[GpmfStream]:
    """All streams of numbers in a payload; GpmfError where it is damaged."""
    found: list[GpmfStream] = []
    _walk(payload, found)
    return found


def _walk(data: bytes, found: list[GpmfStream]) -> None:
    scale: Array | None = None
    letters: str | None = None
    name = orientation = ""
    for key, kind, size, body in _entries(data):
        if kind == "\0":
            _walk(body, found)
        elif key == "TYPE":
            letters = _text(body)
        elif key == "STNM":
            name = _text(body)
        elif key == "ORIN":
            orientation = _text(body)
        elif key == "SCAL":
            scale = _numbers(body, kind, size, None)[:, 0]
            if not scale.all():
                raise GpmfError("a scale of zero")
        elif not _has_text(kind, letters) and key.isalnum() and len(body):
            rows = _numbers(body, kind, size, letters)
            if scale is not None and scale.size in (1, rows.shape[1]):
                found.append(GpmfStream(key, rows / scale, name, orientation))
            elif scale is None:
                found.append(GpmfStream(key, rows, name, orientation))


def _has_text(kind: str, letters: str | None) -> bool:
    return not TEXT.isdisjoint(letters or "" if kind == "?" else kind)


def _text(body: bytes) -> str:
    return body.decode("latin-1").rstrip("\0")


def _entries(data: bytes) -> Iterator[tuple[str, str, int, bytes]]:
    at = 0
    while at + 8 <= len(data):
        if data[at : at + 4] == b"\0\0\0\0":  # padding at the end
            return
        key = data[at : at + 4].decode("latin-1")
        kind, size = chr(data[at + 4]), data[at + 5]
        length = size * int.from_bytes(data[at + 6 : at + 8], "big")
        end = at + 8 + length
        if end > len(data):
            raise GpmfError(f"{key} says that it is longer than what holds it")
        yield key, kind, size, data[at + 8 : end]
        at = end + (-length) % 4


def _numbers(body: bytes, kind: str, size: int, letters: str | None) -> Array:
    """Rows of numbers, (N, fields)."""
    if kind == "?":
        if letters is None:
            raise GpmfError("elements of several types without TYPE")
        kinds = letters
    else:
        if kind not in LETTERS:
            raise GpmfError(f"unknown type {kind!r}")
        kinds = kind * (size // struct.calcsize(">" + LETTERS[kind]))
    if not kinds or not set(kinds) <= LETTERS.keys():
        raise GpmfError(f"unknown types {kinds!r}")
    form = struct.Struct(">" + "".join(LETTERS[letter] for letter in kinds))
    if form.size != size:
        raise GpmfError(f"elements of {size} bytes do not hold {kinds!r}")
    fixed = np.array([FIXED_POINT.get(letter, 1.0) for letter in kinds])
    rows: Array = np.array(list(form.iter_unpack(body)), np.float64).reshape(-1, len(kinds)) * fixed
    return rows
