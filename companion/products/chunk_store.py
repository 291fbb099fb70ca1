"""Point chunks of a flight: the newest in memory, the others in a temporary file."""

from __future__ import annotations

import tempfile
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from companion.messages import PointChunk

POINT = np.dtype(
    [
        ("points_camera", "<f4", 3), ("normals_camera", "<f4", 3), ("sigma", "<f4"),
        ("confidence", "<f4"), ("rgb", "u1", 3),
    ]
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Stored:
    t_ns: int
    spans: Mapping[int, float]
    begin: int
    """Offset in the file."""
    n: int


class ChunkStore:
    """One chunk per keyframe; at most `memory_mb` of their points in memory.

    The rest lies in an unlinked file in `folder`, which the system removes however the program
    ends; without a folder all stays in memory. Chunks that the disk does not take are dropped:
    `n_given_up` points so far.
    """

    def __init__(self, folder: Path | None = None, memory_mb: float = np.inf) -> None:
        self._folder = folder
        self._most = np.inf if folder is None else memory_mb * 1e6 / POINT.itemsize
        self._held: OrderedDict[int, PointChunk] = OrderedDict()
        self._n_held = 0
        self._stored: dict[int, _Stored] = {}
        self._file: IO[bytes] | None = None
        self._end = 0
        self.n_points = 0
        self.n_given_up = 0

    def put(self, chunk: PointChunk) -> None:
        """Add a chunk; replaces an earlier one of that keyframe."""
        before = self._held.pop(chunk.keyframe_id, None)
        if before is not None:
            self._n_held -= len(before.rgb)
            self.n_points -= len(before.rgb)
        elif chunk.keyframe_id in self._stored:
            # its space in the file is lost, which is rare
            self.n_points -= self._stored.pop(chunk.keyframe_id).n
        self._held[chunk.keyframe_id] = chunk
        self._n_held += len(chunk.rgb)
        self.n_points += len(chunk.rgb)
        while self._n_held > self._most and len(self._held) > 1:
            keyframe_id, oldest = self._held.popitem(last=False)
            self._n_held -= len(oldest.rgb)
            try:
                self._stored[keyframe_id] = self._append(oldest)
            except OSError:
                self.n_points -= len(oldest.rgb)
                self.n_given_up += len(oldest.rgb)

    def __contains__(self, keyframe_id: int) -> bool:
        return keyframe_id in self._held or keyframe_id in self._stored

    @property
    def keyframe_ids(self) -> list[int]:
        """Keyframes that have a chunk, ascending."""
        return sorted([*self._held, *self._stored])

    def get(self, keyframe_id: int) -> PointChunk:
        """The chunk of a keyframe; OSError where the file cannot be read."""
        if keyframe_id in self._held:
            return self._held[keyframe_id]
        stored = self._stored[keyframe_id]
        assert self._file is not None
        self._file.seek(stored.begin)
        data = self._file.read(stored.n * POINT.itemsize)
        if len(data) != stored.n * POINT.itemsize:
            raise OSError(f"points of keyframe {keyframe_id} cannot be read back")
        points = np.frombuffer(data, POINT)
        return PointChunk(
            keyframe_id, stored.t_ns, points["points_camera"].copy(), points["rgb"].copy(),
            points["confidence"].copy(), points["normals_camera"].copy(), points["sigma"].copy(),
            stored.spans,
        )  # fmt: skip

    def close(self) -> None:
        """Free memory and file."""
        self._held.clear()
        self._stored.clear()
        self._n_held = 0
        if self._file is not None:
            self._file.close()
            self._file = None

    def _append(self, chunk: PointChunk) -> _Stored:
        if self._file is None:
            assert self._folder is not None
            self._file = tempfile.TemporaryFile(dir=self._folder, buffering=0)
        n = len(chunk.rgb)
        points = np.zeros(n, POINT)
        for name in POINT.names or ():
            points[name] = getattr(chunk, name)
        # what a write that failed has left behind is written over by the next
        begin = self._end
        self._file.seek(begin)
        data = memoryview(points.tobytes())
        while data:
            data = data[self._file.write(data) :]
        self._end = begin + n * POINT.itemsize
        return _Stored(chunk.t_ns, chunk.spans, begin, n)
