"""GStreamer pipelines as cameras (CSI cameras of a Jetson, …), stamped by the pipeline.

The pipeline runs in a process of its own, see `drivers.camera.gstreamer_child`.
"""

from __future__ import annotations

import fcntl
import importlib.util
import os
import select
import struct
import subprocess
import sys
import time
from pathlib import Path

from companion.config import CameraConfig
from companion.errors import ConfigError, SourceError
from drivers.camera.camera_source import DriverFault, EndOfPictures, Picture
from drivers.camera.exposure_choice import Exposure, ExposureRange
from drivers.camera.gstreamer_child import (
    ENDED,
    FAULT,
    GONE,
    HEADER,
    LIMITS,
    NEVER,
    OPENED,
    PICTURE,
    SET,
    SETTING,
)
from drivers.camera.live_exposure import left_to_itself
from drivers.camera.pixel_formats import to_grey_and_rgb

CHILD = Path(__file__).with_name("gstreamer_child.py")
SYSTEM_PYTHON = "/usr/bin/python3"
OPEN_S = 5.0
END_S = 1.0
"""Time after which a pipeline that has not ended is killed."""
PIPE_BYTES = 1 << 20
INSTALL = (
    "apt install python3-gi gir1.2-gstreamer-1.0 gstreamer1.0-plugins-base "
    "gstreamer1.0-plugins-good"
)

GAIN_STEPS = 64
"""Steps of `Exposure.gain` to a gain of one."""
FIRST = Exposure(5_000, 2 * GAIN_STEPS)
"""Setting to begin with: what the source has set is not known. Fit for an overcast day."""

Answer = tuple[bytes, int, int, int, int, bytes]
"""Kind, width, height, stride in bytes, time (ns, CLOCK_MONOTONIC), data."""


class GstreamerCamera:
    """Camera behind a pipeline that is configured up to its appsink."""

    live = True
    start_s = 8.0
    silent_s = 1.5

    def __init__(self, config: CameraConfig) -> None:
        self._pipeline = config.pipeline.strip().rstrip("!").strip()
        # no more of it than this: what follows may hold passwords
        self.name = f"GStreamer {self._pipeline.split()[0]}" if self._pipeline else "GStreamer"
        self.n_dropped = 0
        self.remarks: list[str] = []
        self._child: subprocess.Popen[bytes] | None = None
        self._received = bytearray()
        self._asked = False
        self._stamped_by_us = False
        self._chooses = config.exposure == "tracking"
        self._exposure: Exposure | None = None
        self._limits: ExposureRange | None = None

    def open(self) -> None:
        """Start the pipeline; see `CameraSource`."""
        self.close()
        python = _python_with_gi()
        try:
            self._child = subprocess.Popen(
                [python, "-I", str(CHILD)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0
            )
        except OSError as error:
            raise ConfigError(f"{python}: cannot be run: {error.strerror}") from error
        assert self._child.stdin is not None and self._child.stdout is not None
        os.set_blocking(self._child.stdout.fileno(), False)
        try:
            fcntl.fcntl(self._child.stdout, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        except OSError:
            pass  # a limit of this user; smaller pieces then
        try:
            text = self._pipeline.encode()
            self._send(struct.pack("<I", len(text)) + text)
            answer = self._receive(OPEN_S)
            if answer is None:
                raise SourceError(f"{self.name}: the pipeline does not start in {OPEN_S:g} s")
            self._raise_what_it_says(answer)
            if self._chooses:
                self._take_over_exposure(answer[5])
        except BaseException:
            self.close()
            raise

    def _take_over_exposure(self, limits: bytes) -> None:
        if not limits:
            why = "the pipeline has no libcamerasrc or nvarguscamerasrc with an exposure to set"
            self.remarks.append(left_to_itself(self.name, why))
            return
        shortest_us, longest_us, least, most = LIMITS.unpack(limits)
        gain = round(GAIN_STEPS * least), round(GAIN_STEPS * most)
        self._limits = ExposureRange((shortest_us, longest_us), gain)
        self.set_exposure(
            Exposure(
                min(max(FIRST.exposure_us, shortest_us), longest_us),
                min(max(FIRST.gain or 0, gain[0]), gain[1]),
            )
        )

    @property
    def exposure_range(self) -> tuple[ExposureRange, Exposure] | None:
        """Limits of what can be set, and the setting; None where the camera chooses for itself.

        A gain is in steps, `GAIN_STEPS` to a gain of one.
        """
        if self._limits is None or self._exposure is None:
            return None
        return self._limits, self._exposure

    def set_exposure(self, wanted: Exposure) -> Exposure | None:
        """Set exposure and gain; what was set, None where nothing can be.

        The elements do not say what they have taken.
        """
        if self._limits is None or self._child is None:
            return None
        gain = (wanted.gain or GAIN_STEPS) / GAIN_STEPS
        self._send(SET + SETTING.pack(wanted.exposure_us, gain))
        self._exposure = wanted
        return wanted

    def read(self, timeout_s: float) -> Picture | None:
        """The newest picture of the pipeline; see `CameraSource`."""
        if self._child is None:
            raise SourceError(f"{self.name}: not open")
        if not self._asked:
            self._send(PICTURE)
            self._asked = True
        answer = self._receive(timeout_s)
        if answer is None:
            return None
        self._asked = False
        self._raise_what_it_says(answer)
        kind, width, height, stride, t_ns, data = answer
        arrays = to_grey_and_rgb(kind.decode(), data, width, height, stride)
        if arrays is None:
            self.n_dropped += 1
            return None
        if not t_ns:
            if not self._stamped_by_us:
                self._stamped_by_us = True
                self.remarks.append(
                    f"{self.name}: the pipeline stamps nothing; pictures are stamped when they come"
                )
            t_ns = time.monotonic_ns()
        if self._exposure is not None:  # stamped at the start of readout, as drivers of CSI do
            t_ns -= self._exposure.exposure_us * 1_000 // 2
        return Picture(t_ns, *arrays)

    def close(self) -> None:
        """Stop the pipeline, by force if need be."""
        child, self._child = self._child, None
        self._received.clear()
        self._asked = False
        self._exposure = self._limits = None
        if child is None:
            return
        assert child.stdin is not None and child.stdout is not None
        child.stdin.close()
        child.stdout.close()
        try:
            child.wait(END_S)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()

    def _send(self, data: bytes) -> None:
        assert self._child is not None and self._child.stdin is not None
        try:
            self._child.stdin.write(data)
        except OSError:
            pass  # it has ended; what it said before that is still to be read

    def _receive(self, timeout_s: float) -> Answer | None:
        """Next answer, None if it does not come in time; SourceError if none will come."""
        assert self._child is not None and self._child.stdout is not None
        deadline_s = time.monotonic() + timeout_s
        pipe = self._child.stdout.fileno()
        poll = select.poll()
        poll.register(pipe, select.POLLIN)
        while True:
            answer = self._whole_answer()
            if answer is not None:
                return answer
            if not poll.poll(max(0.0, deadline_s - time.monotonic()) * 1e3):
                return None
            part = os.read(pipe, PIPE_BYTES)
            if not part:
                raise SourceError(f"{self.name}: the pipeline's process has ended")
            self._received += part

    def _whole_answer(self) -> Answer | None:
        received = self._received
        if len(received) < HEADER.size:
            return None
        kind, width, height, stride, t_ns, n_bytes = HEADER.unpack_from(received)
        end = HEADER.size + n_bytes
        if len(received) < end:
            return None
        data = bytes(memoryview(received)[HEADER.size : end])
        del received[:end]
        return kind, width, height, stride, t_ns, data

    def _raise_what_it_says(self, answer: Answer) -> None:
        kind, why = answer[0], answer[5]
        if kind == FAULT:
            raise DriverFault(why.decode(errors="replace"))
        if kind not in (NEVER, GONE, ENDED, OPENED):
            return
        text = f"{self.name}: {why.decode(errors='replace')}"
        if kind == NEVER:
            missing = why.startswith(b"PyGObject") or b"no element" in why
            raise ConfigError(f"camera.pipeline: {text}" + (f"; {INSTALL}" if missing else ""))
        if kind == GONE:
            raise SourceError(text)
        if kind == ENDED:
            raise EndOfPictures(text)


def _python_with_gi() -> str:
    if importlib.util.find_spec("gi") is not None:
        return sys.executable
    if not os.access(SYSTEM_PYTHON, os.X_OK):
        raise ConfigError(
            f'camera.source = "gstreamer" needs {SYSTEM_PYTHON} with GStreamer: {INSTALL}'
        )
    return SYSTEM_PYTHON
