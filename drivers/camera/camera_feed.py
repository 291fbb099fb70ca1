"""Camera supervisor: a thread that keeps a camera open and passes on valid frames."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from companion.config import CameraConfig
from companion.errors import CompanionError, ConfigError
from companion.health import SourceHealth, SourceState
from companion.messages import Frame, Warned
from companion.meters import SourceMeter
from companion.timing.clock import FlightClock
from drivers.camera.camera_source import CameraSource, EndOfPictures, Picture
from drivers.camera.live_exposure import LiveExposure
from drivers.system.fault_trace import FaultTraces

MISSING = "the camera is not there"
GONE = "the camera has gone"
BACK = "the camera is back"
SILENT = "the camera is silent"
FROZEN = "the camera is frozen"
WRONG_SIZE = "pictures of another size are refused"
WRONG_STAMP = "pictures with wrong stamps are refused"
NOT_AS_ASKED = "the camera does not do as asked"
ENDED = "the camera's pictures have ended"
DRIVER_FAULT = "the camera's driver has a fault"

EXPECTED = (CompanionError, OSError)
"""Expected failures of a camera or its connection; any other exception is a bug of its driver."""
RETRY_S = 0.5
"""Interval of attempts to open a missing camera."""
READ_S = 0.1
"""Timeout of a read, so that stopping does not block."""
STOP_S = 2.0
"""Timeout of the thread's end."""
FROZEN_S = 1.0
"""Duration of equal images that means a frozen camera."""
MIN_CONTRAST = 12
"""Least contrast of images that are compared; darker ones, as under a lens cap, may be equal."""
INVALID_S = 1.5
"""Time of invalid images only, after which a camera is reopened."""
BETWEEN_CURES_S = 5.0
"""Least interval of such reopenings."""
MAX_AHEAD_NS, MAX_BEHIND_NS = 50_000_000, 10_000_000_000
"""Largest difference of a stamp from now."""
REPEAT_WARNING_S = 10.0


@dataclass(slots=True)
class _Opening:
    """State since the camera was opened, CLOCK_MONOTONIC in seconds."""

    since_s: float
    picture_s: float | None = None
    """Arrival of the last image, valid or not."""
    invalid_s: float | None = None
    """Time since when all images have been invalid, and the reason."""
    invalid: str = ""


class CameraFeed:
    """Opens a source, and reopens it whenever it is lost, until stopped.

    `deliver` and `warn` are called in its thread and must not block. An image that repeats the one
    before, has another size than the first of all, or an impossible stamp, is dropped and counted.
    """

    def __init__(
        self,
        source: CameraSource,
        clock: FlightClock,
        config: CameraConfig,
        deliver: Callable[[Frame], None],
        warn: Callable[[Warned], None],
    ) -> None:
        self.fault: CompanionError | None = None
        """Reason why the configured camera can never be opened; the thread has then ended."""
        self.size: tuple[int, int] | None = None
        """Width and height of the first image, which all others must have."""
        self.exposure = LiveExposure(source, config)
        self._source = source
        self._clock = clock
        self._rate_hz = config.rate_hz
        self._secrets = {config.url: "camera.url", config.pipeline: "camera.pipeline"}
        self._faults = FaultTraces()
        self._offset_ns = round(config.stamp_offset_ms * 1e6)
        self._deliver = deliver
        self._warn = warn
        self._meter = SourceMeter("camera")
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
        self._n_refused = 0
        self._seq = 0
        self._last_ns: int | None = None
        self._previous: Picture | None = None
        self._cured_s = -BETWEEN_CURES_S
        self._warned_s: dict[str, float] = {}

    @property
    def health(self) -> SourceHealth:
        """Health now; from any thread."""
        health, exposure = self._meter.health(self._clock.now_ns()), self.exposure.now
        if exposure is None:
            return health
        return replace(health, exposure_us=exposure.exposure_us, gain=exposure.gain)

    def start(self) -> None:
        """Start the thread, which opens the camera."""
        self._thread.start()

    def stop(self) -> None:
        """Close the camera and end; a driver that hangs is left behind."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(STOP_S)

    def _run(self) -> None:
        n_opened = 0
        if self.exposure.remark:
            self._warn(Warned(self._clock.now_ns(), NOT_AS_ASKED, self.exposure.remark))
        while not self._stop.is_set():
            try:
                if self._open(n_opened > 0):
                    n_opened += 1
                    self._meter.n_reopened = n_opened - 1
                    self._read_on()
            except Exception as error:  # a driver's bug must not end the flight
                self._set_fault(error)
            self._close()
            if self.fault is not None or self._meter.state == "ended":
                return
            if self._meter.state in ("missing", "driver fault"):
                self._stop.wait(RETRY_S)

    def _open(self, opened_before: bool) -> bool:
        if self._meter.state == "missing":
            self._meter.state = "opening"
        try:
            self._source.open()
        except ConfigError as error:
            self._set("missing", MISSING, str(error))
            if not opened_before:
                self.fault = error
            return False
        except EXPECTED as error:
            self._set("missing", MISSING, self._in_words(error))
            return False
        self.exposure.begin()
        if self._meter.state == "opening":  # else the fault may persist
            self._meter.detail = self._source.name
        return True

    def _close(self) -> None:
        try:
            self._source.close()
        except EXPECTED as error:
            self._meter.detail = self._in_words(error)
        except Exception as error:  # likewise
            self._set_fault(error)

    def _read_on(self) -> None:
        """Deliver images until the camera is lost, or should be reopened."""
        opening = _Opening(time.monotonic())
        while not self._stop.is_set():
            try:
                picture = self._source.read(READ_S)
            except EndOfPictures as error:
                self._set("ended", ENDED, str(error))
                return
            except EXPECTED as error:
                self._set("missing", GONE, self._in_words(error))
                return
            now_s = time.monotonic()
            while self._source.remarks:
                self._warn(Warned(self._clock.now_ns(), NOT_AS_ASKED, self._source.remarks.pop(0)))
            if picture is not None:
                opening.picture_s = now_s
                opening.invalid = self._take(picture)
                if not opening.invalid:
                    opening.invalid_s = None
                elif opening.invalid_s is None:
                    opening.invalid_s = now_s
            self._meter.n_dropped = self._source.n_dropped + self._n_refused
            if self._should_be_cured(opening, now_s):
                return

    def _should_be_cured(self, opening: _Opening, now_s: float) -> bool:
        source = self._source
        if opening.picture_s is None:
            silent = now_s - opening.since_s > source.start_s
        else:
            silent = now_s - opening.picture_s > max(source.silent_s, 3 / self._rate_hz)
        if silent:
            self._set("silent", SILENT, f"{source.name}: no picture comes")
            return source.live
        invalid_s = 0.0 if opening.invalid_s is None else now_s - opening.invalid_s
        if invalid_s > FROZEN_S and self._meter.state == "running":
            if opening.invalid == FROZEN:
                self._set("frozen", FROZEN, f"{source.name}: the same picture again and again")
            else:
                self._set("silent", opening.invalid, f"{source.name}: {opening.invalid}")
        if not source.live or invalid_s < INVALID_S or now_s - self._cured_s < BETWEEN_CURES_S:
            return False
        self._cured_s = now_s
        return True

    def _take(self, picture: Picture) -> str:
        """Deliver an image, or return the reason why it is invalid."""
        now_ns = time.monotonic_ns()
        invalid = self._why_invalid(picture, now_ns)
        if invalid:
            self._n_refused += 1
            return invalid
        if self._meter.state != "running":
            self._recovered()
        t_ns = self._clock.from_monotonic_ns(picture.monotonic_ns + self._offset_ns)
        self._meter.came(self._clock.from_monotonic_ns(now_ns))
        self._deliver(Frame(self._seq, t_ns, picture.grey, picture.rgb))
        self.exposure.take(t_ns, picture.grey)
        self._seq += 1
        return ""

    def _why_invalid(self, picture: Picture, now_ns: int) -> str:
        height, width = picture.grey.shape
        if self.size is None:
            self.size = width, height
        if (width, height) != self.size:
            detail = f"{width} x {height}, wanted are {self.size[0]} x {self.size[1]}"
            self._set("silent", WRONG_SIZE, f"{self._source.name}: {detail}")
            return WRONG_SIZE
        ahead_ns = picture.monotonic_ns - now_ns
        if not -MAX_BEHIND_NS < ahead_ns < MAX_AHEAD_NS:
            detail = f"{self._source.name}: {ahead_ns / 1e6:+.0f} ms from now"
            self._warn_again(WRONG_STAMP, detail)
            return WRONG_STAMP
        if self._last_ns is not None and picture.monotonic_ns <= self._last_ns:
            back_ns = self._last_ns - picture.monotonic_ns
            detail = f"{self._source.name}: {back_ns / 1e6:.1f} ms before the last one's"
            self._warn_again(WRONG_STAMP, detail)
            return WRONG_STAMP
        self._last_ns = picture.monotonic_ns
        previous, self._previous = self._previous, picture
        return FROZEN if previous is not None and _repeats(previous, picture) else ""

    def _recovered(self) -> None:
        before, self._meter.state = self._meter.state, "running"
        self._meter.detail = self._source.name
        if self._seq:
            detail = f"{self._source.name}: it was {before}"
            self._warn(Warned(self._clock.now_ns(), BACK, detail, good=True))
        self._warned_s.clear()

    def _in_words(self, error: Exception) -> str:
        if isinstance(error, OSError):
            return f"{self._source.name}: {error.strerror or error}"
        return str(error)

    def _set_fault(self, error: Exception) -> None:
        """Report a bug: its traceback to the journal, its kind to health."""
        self._faults.tell(error, self._secrets)
        name = type(error).__name__
        self._set("driver fault", DRIVER_FAULT, f"{self._source.name}: {name}, see the journal")

    def _set(self, state: SourceState, what: str, detail: str) -> None:
        """Set the state of the source, and warn if it is new."""
        self._meter.state, self._meter.detail = state, detail
        if what not in self._warned_s:
            self._warned_s[what] = time.monotonic()
            self._warn(Warned(self._clock.now_ns(), what, detail))

    def _warn_again(self, what: str, detail: str) -> None:
        now_s = time.monotonic()
        if now_s - self._warned_s.get(what, -REPEAT_WARNING_S) >= REPEAT_WARNING_S:
            self._warned_s[what] = now_s
            self._warn(Warned(self._clock.now_ns(), what, detail))


def _repeats(previous: Picture, picture: Picture) -> bool:
    # a sensor's noise makes no two pictures equal, not even of a scene that stands still; but in
    # the dark, under a lens cap, it may be less than the first step
    return (
        np.array_equal(previous.grey, picture.grey)
        and np.array_equal(previous.rgb, picture.rgb)
        and int(np.ptp(picture.grey)) >= MIN_CONTRAST
    )
