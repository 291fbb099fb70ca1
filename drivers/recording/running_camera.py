"""Camera of a running daemon, seen by its recording: for programs beside it."""

from __future__ import annotations

import threading
from pathlib import Path

from companion.errors import FlightError, SourceError
from companion.messages import Frame
from companion.timing.clock import monotonic_s, wait_s
from drivers.camera.camera_source import Picture
from drivers.recording.recording_tail import RecordingTail, running_recording

LOOK_EVERY_S = 0.1
"""A recording grows twice a second (recorder.flush_s)."""
SILENT_S = 6.0


class RunningCamera:
    """`CameraSource` of the newest pictures that the daemon at a status socket records."""

    live = True
    start_s = silent_s = SILENT_S
    n_dropped = 0

    def __init__(self, socket: Path) -> None:
        self.name = "the camera of the running companion"
        self.remarks: list[str] = []
        self._socket = socket
        self._tail: RecordingTail | None = None
        self._came_s = 0.0
        self._never = threading.Event()

    def open(self) -> None:
        """See `CameraSource`."""
        self.close()
        self._tail = RecordingTail(running_recording(self._socket))
        self._came_s = monotonic_s()

    def read(self, timeout_s: float) -> Picture | None:
        """See `CameraSource`."""
        assert self._tail is not None
        until_s = monotonic_s() + timeout_s
        while True:
            try:
                frames = self._tail.read(only_newest=True)
            except FlightError as error:
                raise SourceError(str(error)) from error
            for frame in frames:
                if isinstance(frame, Frame):
                    self._came_s = monotonic_s()
                    return Picture(frame.t_ns, frame.grey, frame.rgb)
            if monotonic_s() - self._came_s > SILENT_S:
                raise SourceError(f"{self.name}: its flight has ended; begin again")
            if monotonic_s() > until_s:
                return None
            wait_s(self._never, LOOK_EVERY_S)

    def close(self) -> None:
        """See `CameraSource`."""
        if self._tail is not None:
            self._tail.close()
            self._tail = None
