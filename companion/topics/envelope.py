"""Fields and arrays as bytes: a length (u32, little-endian), a JSON object, then the arrays.

The object's `arrays` lists name, type (as numpy writes it, little-endian) and shape of each, in
their order. Unknown values are null in the object and nan in an array.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.errors import StreamError

VERSION = 1
LENGTH = struct.Struct("<I")
TYPES = frozenset({"|u1", "|i1", "<i4", "<i8", "<f4", "<f8"})
MOST_HEAD_BYTES = 65536
MOST_BYTES = 64 << 20
MOST_ARRAYS, MOST_DIMENSIONS = 32, 3


@dataclass(frozen=True, slots=True, eq=False)
class Envelope:
    """Fields and arrays; getters raise StreamError for missing or invalid values."""

    kind: str
    fields: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]

    def pack(self) -> bytes:
        """Encoded bytes."""
        arrays = {name: _little(array) for name, array in self.arrays.items()}
        listed = [[name, array.dtype.str, list(array.shape)] for name, array in arrays.items()]
        head = {"version": VERSION, "kind": self.kind, **self.fields, "arrays": listed}
        text = json.dumps(head, allow_nan=False).encode()
        return b"".join(
            [LENGTH.pack(len(text)), text, *(array.tobytes() for array in arrays.values())]
        )

    def integer(self, name: str, low: int = 0, high: int = 2**62) -> int:
        """Integer within limits."""
        value = self.fields.get(name)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise StreamError(f"{self.kind}: {name} is not a whole number from {low} to {high}")
        return value

    def number(self, name: str, low: float = -1e12, high: float = 1e12) -> float:
        """Finite number within limits."""
        value = self.fields.get(name)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise StreamError(f"{self.kind}: {name} is not a number")
        if not low <= value <= high:
            raise StreamError(f"{self.kind}: {name} is not from {low:g} to {high:g}")
        return float(value)

    def known(self, name: str) -> bool:
        """True if a field is there and not null."""
        return self.fields.get(name) is not None

    def text(self, name: str, most: int = 200) -> str:
        """Text of limited length."""
        value = self.fields.get(name)
        if not isinstance(value, str) or len(value) > most:
            raise StreamError(f"{self.kind}: {name} is not a text of at most {most} letters")
        return value

    def flag(self, name: str) -> bool:
        """True or false."""
        value = self.fields.get(name)
        if not isinstance(value, bool):
            raise StreamError(f"{self.kind}: {name} is not true or false")
        return value

    def part(self, name: str) -> Envelope:
        """A nested object, without arrays."""
        value = self.fields.get(name)
        if not isinstance(value, dict):
            raise StreamError(f"{self.kind}: {name} is not an object")
        return Envelope(f"{self.kind}.{name}", value, {})

    def numbers(self, name: str, n: int, below: float) -> list[float]:
        """List of n numbers of magnitude less than `below`."""
        values = self.fields.get(name)
        if not isinstance(values, list) or len(values) != n:
            raise StreamError(f"{self.kind}: {name} is not a list of {n} numbers")
        if not all(type(v) in (int, float) and abs(v) < below for v in values):
            raise StreamError(f"{self.kind}: {name} has what is no number")
        return [float(v) for v in values]

    def array(self, name: str, dtype: str, *shape: int, finite: bool = True) -> NDArray[Any]:
        """Array of a type and shape, -1 being any length; finite unless stated otherwise."""
        array = self.arrays.get(name)
        if array is None or array.dtype.str != np.dtype(dtype).str or array.ndim != len(shape):
            raise StreamError(f"{self.kind}: {name} is not an array of {dtype}")
        if any(want not in (-1, have) for want, have in zip(shape, array.shape, strict=True)):
            raise StreamError(f"{self.kind}: {name} has the shape {array.shape}")
        if finite and array.dtype.kind == "f" and not np.isfinite(array).all():
            raise StreamError(f"{self.kind}: {name} is not finite")
        return array


def unpack(data: bytes) -> Envelope:
    """Decode an envelope; StreamError if invalid. The arrays may be views of `data`."""
    try:
        return _unpack(data)
    except (ValueError, TypeError, RecursionError, struct.error) as error:
        raise StreamError(f"a message that cannot be read: {error}") from error


def _unpack(data: bytes) -> Envelope:
    if len(data) > MOST_BYTES:
        raise ValueError(f"{len(data)} bytes")
    (length,) = LENGTH.unpack_from(data)
    at = LENGTH.size + length
    if length > MOST_HEAD_BYTES or at > len(data):
        raise ValueError(f"a head of {length} bytes")
    head = json.loads(data[LENGTH.size : at], parse_constant=_no_constant)
    if not isinstance(head, dict) or head.get("version") != VERSION:
        raise ValueError("not of this version")
    kind, listed = head.get("kind"), head.get("arrays")
    if not isinstance(kind, str) or not isinstance(listed, list) or len(listed) > MOST_ARRAYS:
        raise ValueError("no kind, or no list of arrays")
    arrays: dict[str, NDArray[Any]] = {}
    for name, dtype, shape in listed:
        if dtype not in TYPES or len(shape) > MOST_DIMENSIONS or name in arrays:
            raise ValueError(f"an array of {dtype}")
        if not all(type(side) is int and 0 <= side <= MOST_BYTES for side in shape):
            raise ValueError(f"an array of the shape {shape}")
        n = math.prod(shape)
        n_bytes = n * np.dtype(dtype).itemsize
        if at + n_bytes > len(data):
            raise ValueError("it ends early")
        # where it lies need not be where its type may lie, which not every library minds
        found = np.frombuffer(data, dtype, n, at).reshape(shape)
        arrays[name] = np.require(found, requirements="A")
        at += n_bytes
    if at != len(data):
        raise ValueError("it does not end where it should")
    return Envelope(kind, head, arrays)


def finite_or_none(value: float) -> float | None:
    """A number for JSON; None unless finite."""
    return float(value) if math.isfinite(value) else None


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} is no number")


def _little(array: NDArray[Any]) -> NDArray[Any]:
    out = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    if out.dtype.str not in TYPES:
        raise TypeError(f"an array of {out.dtype} does not go into an envelope")
    return out
