"""Log of the cloud that this node makes of a flight, from which a restart continues.

A file of cloud envelopes, each after its length (u32, little-endian). An incomplete last one is
ignored.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from companion.errors import StreamError
from companion.messages import PointChunk
from companion.topics.envelope import LENGTH, MOST_BYTES, Envelope, unpack
from companion.topics.message_codec import cloud_envelope, cloud_of_envelope

NAME = "cloud.chunks"
STEP_BACK = 4
"""Depth maps whose neighbours were lost with the node; they are recomputed."""
MARGIN = 2
"""Bundles before the first of them, whose frames it uses."""


@dataclass(frozen=True, slots=True, eq=False)
class Kept:
    """A chunk, and the number of the bundle that its keyframe came with."""

    chunk: PointChunk
    run: str
    number: int


class KeptChunks:
    """The log file in a flight's folder. OSError where the folder cannot be written."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / NAME
        self.found: list[Kept] = []
        """Chunks found in the file."""
        end = 0
        if self._path.exists():
            end = self._read()
        self._file = self._path.open("ab")
        self._file.truncate(end)
        self._have = {kept.chunk.keyframe_id for kept in self.found}

    def put(self, flight: str, chunk: PointChunk, run: str, number: int) -> bool:
        """Append a chunk; False where there is one of its keyframe, which then counts."""
        if chunk.keyframe_id in self._have:
            return False
        self._have.add(chunk.keyframe_id)
        made = cloud_envelope(flight, chunk, None)
        fields = {**made.fields, "run": run, "number": number}
        data = Envelope(made.kind, fields, made.arrays).pack()
        self._file.write(LENGTH.pack(len(data)) + data)
        self._file.flush()
        return True

    def resume_after(self, run: str) -> int:
        """Bundle of a run after which to continue; -1: from the oldest available."""
        numbers = sorted(kept.number for kept in self.found if kept.run == run)
        return max(numbers[-STEP_BACK] - MARGIN, -1) if len(numbers) >= STEP_BACK else -1

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read(self) -> int:
        """Read complete entries; returns the offset of their end."""
        end = 0
        with self._path.open("rb") as file:
            while len(head := file.read(LENGTH.size)) == LENGTH.size:
                (length,) = LENGTH.unpack(head)
                data = file.read(length) if length <= MOST_BYTES else b""
                if len(data) < length or not data:
                    break
                try:
                    envelope = unpack(data)
                    chunk = cloud_of_envelope(envelope)
                    run, number = envelope.text("run"), envelope.integer("number", -1)
                except StreamError:
                    break
                self.found.append(Kept(chunk, run, number))
                end = file.tell()
        return end
