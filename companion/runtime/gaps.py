"""Gap detection: missing frames, a frozen image, telemetry that stops.

Messages pass unchanged; a `Warned` is added at a gap.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator

import numpy as np

from companion.messages import Bytes, Frame, Message, Warned
from companion.telemetry import AttitudeSample, PositionSample

GAP_IN_INTERVALS = 5
"""Silence of this many median intervals is a gap."""
MIN_INTERVALS = 3
"""Intervals needed for a median."""
MIN_FRAME_GAP_S = 0.3
MIN_TELEMETRY_GAP_S = 2.0
STILL_S = 0.5
STILL_GREY = 0.3
"""Largest mean difference of equal images that were encoded again, grey levels."""
SAMPLE_STEP = 8


class IntervalMonitor:
    """Median interval and last time of a periodic input."""

    def __init__(self, min_gap_s: float) -> None:
        self._min_gap_s = min_gap_s
        self._intervals_s: deque[float] = deque(maxlen=31)
        self._last_ns: int | None = None

    def silence_s(self, t_ns: int) -> float | None:
        """Seconds since the last arrival if that is a gap, else None."""
        if self._last_ns is None or len(self._intervals_s) < MIN_INTERVALS:
            return None
        silence_s = (t_ns - self._last_ns) * 1e-9
        usual_s = float(np.median(self._intervals_s))
        limit_s = max(self._min_gap_s, GAP_IN_INTERVALS * usual_s)
        return silence_s if silence_s > limit_s else None

    def arrived(self, t_ns: int) -> None:
        """Note an arrival."""
        if self._last_ns is not None:
            self._intervals_s.append((t_ns - self._last_ns) * 1e-9)
        self._last_ns = t_ns


class GapMonitor:
    """Takes every message in order of time, and warns of gaps."""

    def __init__(self) -> None:
        self._frames = IntervalMonitor(MIN_FRAME_GAP_S)
        self._telemetry = {
            "attitude": IntervalMonitor(MIN_TELEMETRY_GAP_S),
            "position": IntervalMonitor(MIN_TELEMETRY_GAP_S),
        }
        self._silent: set[str] = set()
        self._image: Bytes | None = None
        self._still_since_ns = 0
        self._still = False

    def step(self, message: Message) -> list[Warned]:
        """Take one message."""
        if isinstance(message, AttitudeSample):
            self._arrived("attitude", message.t_ns)
        elif isinstance(message, PositionSample):
            self._arrived("position", message.t_ns)
        elif isinstance(message, Frame):
            return [
                *self._missing_frames(message),
                *self._silent_telemetry(message.t_ns),
                *self._still_image(message),
            ]
        return []

    def _arrived(self, kind: str, t_ns: int) -> None:
        self._telemetry[kind].arrived(t_ns)
        self._silent.discard(kind)

    def _missing_frames(self, frame: Frame) -> Iterator[Warned]:
        silence_s = self._frames.silence_s(frame.t_ns)
        self._frames.arrived(frame.t_ns)
        if silence_s is not None:
            yield Warned(frame.t_ns, "frames are missing", f"none for {silence_s:.1f} s")

    def _silent_telemetry(self, t_ns: int) -> Iterator[Warned]:
        for kind, monitor in self._telemetry.items():
            silence_s = monitor.silence_s(t_ns)
            if silence_s is not None and kind not in self._silent:
                self._silent.add(kind)
                yield Warned(t_ns, f"{kind} telemetry stops", f"none for {silence_s:.1f} s")

    def _still_image(self, frame: Frame) -> Iterator[Warned]:
        image = frame.grey[::SAMPLE_STEP, ::SAMPLE_STEP]
        before, self._image = self._image, image.copy()
        if before is None or _difference(before, image) > STILL_GREY:
            self._still_since_ns, self._still = frame.t_ns, False
        elif not self._still and frame.t_ns - self._still_since_ns > STILL_S * 1e9:
            self._still = True
            yield Warned(frame.t_ns, "the image stands still", f"for {STILL_S:g} s or more")


def with_gap_warnings(messages: Iterable[Message]) -> Iterator[Message]:
    """The same messages, with a `Warned` before the one that reveals a gap."""
    watch = GapMonitor()
    for message in messages:
        yield from watch.step(message)
        yield message


def _difference(a: Bytes, b: Bytes) -> float:
    return float(np.abs(a.astype(np.int16) - b).mean())
