"""Tracks of a flight as rows of arrays: hours of flight take some megabytes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from companion.geometry.transforms import Pose
from companion.messages import Track, TrackRefined, TrackState

STATES = tuple(TrackState)
TRACKING = STATES.index(TrackState.TRACKING)
NONE = -1
ROW = np.dtype(
    [
        ("seq", "<i8"), ("t_ns", "<i8"), ("keyframe_id", "<i8"), ("rotation", "<f8", (3, 3)),
        ("translation", "<f8", 3), ("n_inliers", "<i4"), ("n_matches", "<i4"), ("state", "u1"),
        ("backfilled", "?"),
    ]
)  # fmt: skip
BLOCK = 4096
"""Rows allocated at once."""


class TrackStore:
    """Takes tracks in any order, gives one per frame: the last that was tracking, else the last.

    Keeps of each what results need; the keyframe's pose at that time, keypoints and sigmas are
    dropped.
    """

    def __init__(self) -> None:
        self._blocks: list[np.ndarray] = []
        self._n = 0

    def put(self, track: Track) -> None:
        """Add a track."""
        at = self._n % BLOCK
        if at == 0:
            self._blocks.append(np.zeros(BLOCK, ROW))
        row = self._blocks[-1][at]
        row["seq"], row["t_ns"], row["state"] = track.seq, track.t_ns, STATES.index(track.state)
        row["n_inliers"], row["n_matches"] = track.n_inliers, track.n_matches
        row["backfilled"] = track.backfilled
        relative = track.keyframe_from_camera
        if track.keyframe_id is None or relative is None:
            row["keyframe_id"] = NONE
        else:
            row["keyframe_id"] = track.keyframe_id
            row["rotation"], row["translation"] = relative.rotation, relative.translation
        self._n += 1

    def refine(self, refined: TrackRefined) -> None:
        """Replace the pose of a track; nothing where there is none."""
        for block in reversed(self._blocks):  # mostly in the newest
            rows = np.flatnonzero((block["seq"] == refined.seq) & (block["state"] == TRACKING))
            if len(rows):
                row, relative = block[rows[-1]], refined.keyframe_from_camera
                row["keyframe_id"] = refined.keyframe_id
                row["rotation"], row["translation"] = relative.rotation, relative.translation
                return

    def __iter__(self) -> Iterator[Track]:
        """One track per frame, in order of frames."""
        if not self._n:
            return
        rows = np.concatenate(self._blocks)[: self._n]
        is_tracking = rows["state"] == TRACKING
        # of each frame the last in this order counts
        order = np.lexsort((np.arange(self._n), is_tracking, rows["seq"]))
        seqs = rows["seq"][order]
        for row in rows[order[np.r_[seqs[1:] != seqs[:-1], True]]]:
            known = row["keyframe_id"] != NONE
            yield Track(
                int(row["seq"]), int(row["t_ns"]), STATES[row["state"]], None,
                int(row["keyframe_id"]) if known else None,
                Pose(row["rotation"], row["translation"]) if known else None,
                int(row["n_inliers"]), int(row["n_matches"]), None, bool(row["backfilled"]),
            )  # fmt: skip
