"""Rotating .rrd files of a flight.

They are parts of one recording: a viewer that is given several shows them as one.
"""

from __future__ import annotations

import errno
import os
import shutil
import threading
import uuid
from pathlib import Path

import rerun as rr

from companion.streaming.viewer.layout import layout

APPLICATION = "companion-2"
"""Viewers store a layout by this name: a new layout has a new number."""
N_FILES = 4
"""Number of files that share the size limit."""
LOOK_SHARE, LOOK_BYTES = 1 / 32, 8 << 20
"""Part of a file, and so many bytes at most, that are drawn until its size and the disk are looked
at: that waits for the disk."""
FLUSH_S = 20.0
"""A disk that takes longer for some megabytes takes nothing more."""
LEFT_FREE_BYTES = 64 << 20
"""Room for path, cloud and report of some minutes, which are worth more than the viewer's file."""


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
        self._n_drawn = 0
        """Bytes, of the messages, since the size of the file was looked at."""
        self.recording = self._begin()

    def is_full(self, n_bytes: int) -> bool:
        """True if the next file is due, after so many more bytes; the disk is seldom checked.

        OSError where the recording cannot be written, or would take the room of the results.
        """
        self._n_drawn += n_bytes
        if self._n_drawn < min(LOOK_SHARE * self._each or LOOK_BYTES, LOOK_BYTES):
            return False
        self._n_drawn = 0
        if shutil.disk_usage(self._first.parent).free < LEFT_FREE_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._paths[-1]))
        if not self._each:
            return False
        try:
            self.recording.flush(timeout_sec=FLUSH_S)  # what waits for the disk counts too
        except RuntimeError as error:  # its thread ends with the first thing it cannot write
            raise self._fault(error) from None
        return self._paths[-1].stat().st_size >= self._each

    def next(self) -> rr.RecordingStream:
        """Close the file, and begin another; deletes the oldest beyond the limit."""
        self.close()
        while len(self._paths) >= N_FILES:
            self._paths.pop(0).unlink(missing_ok=True)
        self.recording = self._begin()
        return self.recording

    def close(self) -> None:
        """Write the rest; OSError where that is not done in FLUSH_S.

        Rerun waits for ever for a file that cannot be written, also as the program ends: it does
        so in a thread that is left behind then.
        """
        closing = threading.Thread(target=self.recording.disconnect, name="rrd end", daemon=True)
        closing.start()
        closing.join(FLUSH_S)
        if closing.is_alive():
            rr.unregister_shutdown()
            raise self._fault("no answer from the disk")

    def _fault(self, why: object) -> OSError:
        return OSError(errno.EIO, str(why), str(self._paths[-1]))

    def _begin(self) -> rr.RecordingStream:
        self._n_begun += 1
        number = f"-{self._n_begun}" if self._n_begun > 1 else ""
        path = self._first.with_name(f"{self._first.stem}{number}{self._first.suffix}")
        self._paths.append(path)
        recording = rr.RecordingStream(APPLICATION, recording_id=self._id)
        try:
            recording.save(
                path, default_blueprint=layout(live=False), write_footer=self._indexed
            )  # fmt: skip
        except RuntimeError as error:
            raise self._fault(error) from None
        except UnicodeEncodeError:
            raise self._fault("its name is not UTF-8 text; PYTHONUTF8=1 reads it as such") from None
        return recording
