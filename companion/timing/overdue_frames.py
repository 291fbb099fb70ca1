"""Notices of frames that were due and did not come, so that poses go on without a picture."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator

from companion.messages import NO_PICTURE, Frame, FrameOverdue, Message
from companion.telemetry import Telemetry

OVERDUE_NS = 130_000_000
"""Between the pose gate's 200 ms and what a frame of a busy computer is late by."""
OVERDUE_PERIODS = 1.7
"""The same of a slow camera: one frame is lost."""
LONGEST_NS, SELDOM_NS = 30_000_000_000, 1_000_000_000
"""Inertial navigation is of use for that long at most; then notices are for the telemetry that
waits: it is taken with them."""
N_INTERVALS = 15


class OverdueFrames:
    """Takes the frames, and gives notices while none comes, one period apart at first.

    Times are nanoseconds on the flight's clock. `came` may be called from another thread.
    """

    def __init__(self) -> None:
        self._intervals_ns: deque[int] = deque(maxlen=N_INTERVALS)
        self._newest: tuple[int, int, int] | None = None
        """Of the newest frame: its number, time of arrival, and latency; set as one."""
        self._period_ns = 0
        self._noticed: tuple[int, int] | None = None
        """Number of the frame that notices were given after, and when the next is due."""
        self._n_given = 0

    def came(self, frame: Frame, now_ns: int) -> None:
        """Take the arrival of a frame."""
        if self._newest is not None:
            self._intervals_ns.append(now_ns - self._newest[1])
            ordered, n = sorted(self._intervals_ns), len(self._intervals_ns)
            self._period_ns = (ordered[(n - 1) // 2] + ordered[n // 2]) // 2
        self._newest = frame.seq, now_ns, max(now_ns - frame.t_ns, 0)

    def due_ns(self) -> int | None:
        """Time of the next notice if no frame comes before; None where none is due."""
        newest = self._newest
        if newest is None or len(self._intervals_ns) < N_INTERVALS:
            return None
        seq, arrived_ns, _ = newest
        if self._noticed is not None and self._noticed[0] == seq:
            due_ns = self._noticed[1]
        else:
            due_ns = arrived_ns + max(OVERDUE_NS, int(OVERDUE_PERIODS * self._period_ns))
        return due_ns

    def due(self, now_ns: int) -> FrameOverdue | None:
        """The notice that is due now, if any: of the time at which a frame was to be exposed."""
        newest, due_ns = self._newest, self.due_ns()
        if newest is None or due_ns is None or now_ns < due_ns:
            return None
        if now_ns - due_ns > OVERDUE_NS:
            due_ns = now_ns  # whoever asks was away himself
        seq, arrived_ns, latency_ns = newest
        late = due_ns - arrived_ns > LONGEST_NS
        self._noticed = seq, due_ns + (SELDOM_NS if late else self._period_ns)
        self._n_given += 1
        return FrameOverdue(NO_PICTURE + self._n_given, due_ns - latency_ns)


def with_notices(messages: Iterable[Message]) -> Iterator[Message]:
    """Messages in order of time, with the notices that a camera would have had in flight."""
    overdue = OverdueFrames()
    for message in messages:
        if isinstance(message, Frame | Telemetry):
            while (notice := overdue.due(message.t_ns)) is not None:
                yield notice
        if isinstance(message, Frame):
            overdue.came(message, message.t_ns)
        yield message
