"""Rotating .rrd files of a flight.

They are parts of one recording: a viewer that is given several shows them as one.
"""

from __future__ import annotations

import uuid
from pathlib import Path

import rerun as rr

from companion.streaming.viewer.layout import layout

APPLICATION = "companion-2"
"""Viewers store a layout by this name: a new layout has a new number."""
N_FILES = 4
"""Number of files that share the size limit."""
LOOK_EVERY = 16


class RrdFiles:
    """Files of one flight: `path` (flight.rrd), then flight-2.rrd and so on.

    `most_bytes` is 0 for no limit. With `indexed` each ends with an index of its chunks, for
    programs that seek in it. Until then the index is in memory, and grows by some kilobytes with
    each frame: not for flights of hours.
    """

    def __init__(self, path: Path, most_bytes: int, indexed: bool) -> None:
        self._indexed = indexed
        self._first, self._each = path, most_bytes // N_FILES
        self._id = str(uuid.uuid4())
        self._paths: list[Path] = []
        self._n_begun = 0
        self._n_looked = 0
        self.recording = self._begin()

    def is_full(self) -> bool:
        """True if the next file is due; the disk is checked on every LOOK_EVERY-th call only.

        OSError where the recording cannot be written.
        """
        self._n_looked += 1
        if not self._each or self._n_looked % LOOK_EVERY:
            return False
        try:
            self.recording.flush()  # what waits for the disk counts too
        except RuntimeError as error:  # its thread ends with the first thing it cannot write
            raise OSError(f"{self._paths[-1]}: cannot be written: {error}") from None
        return self._paths[-1].stat().st_size >= self._each

    def next(self) -> rr.RecordingStream:
        """Close the file, and begin another; deletes the oldest beyond the limit."""
        self.recording.disconnect()
        while len(self._paths) >= N_FILES:
            self._paths.pop(0).unlink(missing_ok=True)
        self.recording = self._begin()
        return self.recording

    def close(self) -> None:
        """Write the rest."""
        self.recording.disconnect()

    def _begin(self) -> rr.RecordingStream:
        self._n_begun += 1
        number = f"-{self._n_begun}" if self._n_begun > 1 else ""
        path = self._first.with_name(f"{self._first.stem}{number}{self._first.suffix}")
        self._paths.append(path)
        recording = rr.RecordingStream(APPLICATION, recording_id=self._id)
        recording.save(
            path, default_blueprint=layout(live=False), write_footer=self._indexed
        )  # fmt: skip
        return recording
