"""Cloud snapshots in flight, gathered in slices between the messages that stage `results` takes."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

from companion.products.atomic_file import write_atomically
from companion.products.cloud import Cloud
from companion.products.cloud_ply import ply_parts
from companion.products.flight_result import FlightResult
from companion.runtime.stage_protocol import Snapshot, TakeSnapshot
from companion.timing.clock import monotonic_s

WORK_S = 0.01
"""Longest delay of a message to stage `results`, seconds."""
GATHERED_PERCENT = 90
NO_POINTS = "there are no points yet"
BUSY = "another is being written"


class CloudSnapshots:
    """Writes snapshot-NNN.ply into a folder, one at a time."""

    def __init__(self, folder: Path, result: FlightResult, voxel_m: float) -> None:
        self._folder, self._result, self._voxel_m = folder, result, voxel_m
        self._asked: TakeSnapshot | None = None
        self._gathering: Generator[float, None, Cloud] | None = None
        self._percent = 0
        self._refused: list[Snapshot] = []

    def begin(self, asked: TakeSnapshot) -> None:
        """Begin a snapshot; refused while another is under way."""
        if self._gathering is not None:
            self._refused.append(Snapshot(asked.number, why_not=BUSY))
            return
        self._asked, self._percent = asked, 0
        self._gathering = self._result.gather_cloud(self._voxel_m)

    def step(self) -> list[Snapshot]:
        """Work for a moment; progress to report."""
        out, self._refused = self._refused, []
        if self._gathering is None or self._asked is None:
            return out
        until_s, share = monotonic_s() + WORK_S, 0.0
        try:
            while monotonic_s() < until_s:
                share = next(self._gathering)
        except StopIteration as over:
            out.append(self._written(over.value))
            self._gathering = None
            return out
        except OSError as error:  # points that lie on a disk which does not give them back
            out.append(Snapshot(self._asked.number, why_not=str(error)))
            self._gathering = None
            return out
        percent = int(GATHERED_PERCENT * share)
        if percent > self._percent:
            self._percent = percent
            out.append(Snapshot(self._asked.number, percent))
        return out

    def _written(self, cloud: Cloud) -> Snapshot:
        assert self._asked is not None
        number, found = self._asked.number, self._result.georeference
        if not len(cloud):
            return Snapshot(number, why_not=NO_POINTS)
        origin = self._asked.origin if found is not None and found.has_origin else None
        path = self._folder / f"snapshot-{number:03d}.ply"
        try:
            write_atomically(path, ply_parts(cloud, self._result.unit, origin))
        except OSError as error:
            return Snapshot(number, why_not=f"{path}: {error.strerror}")
        return Snapshot(number, 100, str(path), len(cloud))
