"""Points in few bytes: quantised by their distance, sorted along a Morton curve, and deflated.

A point takes 5 to 6 bytes with its colour. Sorted by Morton code, neighbours in space follow each
other, so that differences are small; the error of a coordinate is half a step, a step being
1/1024 of the median distance, which is less than what depth is known to.
"""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from companion.errors import StreamError
from companion.messages import Bytes, Floats

STEPS_PER_DEPTH = 1024
MOST_BITS = 20
"""Bits of a coordinate; a wider range gets a larger step."""
HEAD = struct.Struct("<Iffff")
N_MOST = 2_000_000
LEVELS_OF_CONFIDENCE = 7


def encode_points(points: Floats, rgb: Bytes, confidence: Floats) -> bytes:
    """Bytes of points (N, 3), colours (N, 3), confidences (N,); their order is lost.

    Points that are not finite are left out.
    """
    kept = np.isfinite(points).all(axis=1)
    points, rgb, confidence = points[kept], rgb[kept], confidence[kept]
    if len(points) == 0:
        return HEAD.pack(0, 1.0, 0.0, 0.0, 0.0)
    low = points.min(axis=0)
    extent = float((points - low).max())
    depth = float(np.median(np.linalg.norm(points, axis=1)))
    step = max(depth / STEPS_PER_DEPTH, extent / (2**MOST_BITS - 2), 1e-9)
    cells = np.rint((points - low) / np.float32(step)).astype(np.uint64)
    code = _interleave(cells)
    order = np.argsort(code, kind="stable")
    code = code[order]
    gaps = np.diff(code, prepend=np.uint64(0))
    packed = (rgb[order].astype(np.uint8) >> np.array([3, 2, 3], np.uint8)).astype(np.uint8)
    sure = np.rint(np.clip(confidence[order], 0, 1) * LEVELS_OF_CONFIDENCE).astype(np.uint8)
    planes = [_varints(gaps), *(np.diff(plane, prepend=plane.dtype.type(0)).tobytes()
                                for plane in (packed[:, 1],)),
              *(np.diff((packed[:, k].astype(np.int16) - (packed[:, 1] >> 1)).astype(np.uint8),
                        prepend=np.uint8(0)).tobytes() for k in (0, 2)),
              sure.tobytes()]  # fmt: skip
    body = b"".join(struct.pack("<I", len(plane)) + plane for plane in planes)
    return HEAD.pack(len(points), step, *map(float, low)) + zlib.compress(body, 6)


def decode_points(data: bytes) -> tuple[Floats, Bytes, Floats]:
    """Points (N, 3), colours (N, 3), confidences (N,); StreamError for malformed bytes."""
    try:
        n, step, *low = HEAD.unpack_from(data)
        if n == 0:
            return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.float32)
        if n > N_MOST:
            raise ValueError(f"{n} points")
        body = zlib.decompressobj().decompress(data[HEAD.size :], 32 * n + 64)
        planes = []
        at = 0
        for _ in range(5):
            (size,) = struct.unpack_from("<I", body, at)
            planes.append(np.frombuffer(body, np.uint8, size, at + 4))
            at += 4 + size
        code = np.cumsum(_from_varints(planes[0], n), dtype=np.uint64)
        cells = _separate(code)
        points = (cells * np.float32(step) + np.array(low, np.float32)).astype(np.float32)
        green = np.cumsum(planes[1], dtype=np.uint8)
        others = [np.cumsum(plane, dtype=np.uint8) + (green >> 1) for plane in planes[2:4]]
        rgb = np.stack([others[0] << 3, green << 2, others[1] << 3], axis=1).astype(np.uint8)
        rgb |= np.array([4, 2, 4], np.uint8)
        sure = planes[4].astype(np.float32) / np.float32(LEVELS_OF_CONFIDENCE)
        if not len(points) == len(rgb) == len(sure) == n:
            raise ValueError("planes of unequal lengths")
        return points, rgb, sure
    except (ValueError, struct.error, zlib.error) as error:
        raise StreamError(f"points cannot be decoded: {error}") from error


def coarse_of(points: Floats, side: float, most: int) -> NDArray[np.intp]:
    """Indices of the coarse level: the first point in each voxel of that side, `most` at most."""
    if len(points) == 0:
        return np.zeros(0, np.intp)
    cells = np.floor((points - points.min(axis=0)) / np.float32(side)).astype(np.uint64)
    cells = np.minimum(cells, np.uint64(2**MOST_BITS - 1))
    _, first = np.unique(_interleave(cells), return_index=True)
    if len(first) > most:
        first = first[np.linspace(0, len(first) - 1, most).astype(np.intp)]
    return np.sort(first)


def _interleave(cells: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Morton codes (N,) of cells (N, 3) of up to 21 bits."""
    x, y, z = (_spread(cells[:, k]) for k in range(3))
    code: NDArray[np.uint64] = x | (y << np.uint64(1)) | (z << np.uint64(2))
    return code


def _separate(code: NDArray[np.uint64]) -> NDArray[np.float32]:
    return np.stack([_gather(code >> np.uint64(k)) for k in range(3)], axis=1).astype(np.float32)


SHIFTS = ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
          (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249))  # fmt: skip


def _spread(value: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Insert two zeros before each of the low 21 bits."""
    for shift, mask in SHIFTS:
        value = (value | (value << np.uint64(shift))) & np.uint64(mask)
    return value


def _gather(value: NDArray[np.uint64]) -> NDArray[np.uint64]:
    value = value & np.uint64(SHIFTS[-1][1])
    masks = [0x1FFFFF] + [mask for _, mask in SHIFTS[:-1]]
    for (shift, _), mask in zip(reversed(SHIFTS), reversed(masks), strict=True):
        value = (value | (value >> np.uint64(shift))) & np.uint64(mask)
    return value


def _varints(values: NDArray[np.uint64]) -> bytes:
    """LEB128: seven bits a byte, low ones first; a set high bit says that more follow."""
    n_bytes = np.ones(len(values), np.int64)
    rest = values >> np.uint64(7)
    while rest.any():
        n_bytes += rest > 0
        rest >>= np.uint64(7)
    ends = np.cumsum(n_bytes)
    out = np.zeros(int(ends[-1]), np.uint8)
    for k in range(int(n_bytes.max())):
        longer = n_bytes > k
        low = ((values[longer] >> np.uint64(7 * k)) & np.uint64(0x7F)).astype(np.uint8)
        more = (n_bytes[longer] > k + 1).astype(np.uint8) << np.uint8(7)
        out[ends[longer] - n_bytes[longer] + k] = low | more
    return out.tobytes()


def _from_varints(data: Bytes, n: int) -> NDArray[np.uint64]:
    is_last = data < 0x80
    ends = np.flatnonzero(is_last)
    if len(ends) != n or (n and ends[-1] != len(data) - 1):
        raise ValueError("a broken row of numbers")
    starts = np.concatenate([[0], ends[:-1] + 1])
    within = np.arange(len(data)) - np.repeat(starts, ends - starts + 1)
    if within.max(initial=0) > 9:
        raise ValueError("a number that is too long")
    bits = (data & 0x7F).astype(np.uint64) << (within.astype(np.uint64) * np.uint64(7))
    return np.bitwise_or.reduceat(bits, starts)
