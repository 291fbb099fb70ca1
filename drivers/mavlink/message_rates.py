"""Message rates: requested from the autopilot, measured, and requested again if missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from drivers.telemetry.mavlink_samples import Wanted

CHECK_NS = 3_000_000_000
"""Window in which a rate is measured."""
SHORT = 0.5
"""Share of the requested rate below which it counts as missing."""
FIRST_AGAIN_NS, MOST_AGAIN_NS = 3_000_000_000, 60_000_000_000
"""Backoff of repeated requests, doubling."""
NEVER_NS = 2**62
STEADY_HZ = 5.0
"""Least rate of a message that a window tells to a few percent."""


@dataclass(slots=True)
class _Stream:
    want: Wanted
    choice: int = 0
    due_ns: int = 0
    again_ns: int = FIRST_AGAIN_NS
    begun_ns: int | None = None
    """Begin of the measurement; None before the first request."""
    n: int = 0
    came_hz: float | None = None
    """Rate in the last whole window."""
    is_new: bool = False

    @property
    def message_id(self) -> int:
        return self.want.ids[self.choice]


class MessageRates:
    """State of every quantity; asks no clock and sends nothing itself."""

    def __init__(self, wants: Sequence[Wanted]) -> None:
        self._wants = tuple(wants)
        self._streams = [_Stream(want) for want in wants]
        self.missing: list[int] = []
        """Messages that this autopilot has reported as unsupported."""

    def restart(self) -> None:
        """Request everything anew, but what was added later: the autopilot has rebooted."""
        self._streams = [_Stream(want) for want in self._wants]
        self.missing = []

    def change(self, want: Wanted) -> None:
        """Request a quantity that is new, or at another rate; 0 leaves it to the autopilot."""
        for stream in self._streams:
            if stream.want.ids == want.ids:
                stream.want, stream.due_ns, stream.begun_ns = want, 0, None
                stream.again_ns = FIRST_AGAIN_NS
                return
        if want.rate_hz > 0:
            self._streams.append(_Stream(want))

    def came(self, message_id: int) -> None:
        """Count a message."""
        for stream in self._streams:
            if message_id in stream.want.ids and message_id == stream.message_id:
                stream.n += 1

    def shares(self) -> dict[int, float] | None:
        """Measured over requested rate of what is always sent, at most 1; None until it is known.

        What was added later is not among them.
        """
        shares = {}
        for stream in self._streams[: len(self._wants)]:
            if stream.want.always and stream.want.rate_hz >= STEADY_HZ:
                if stream.came_hz is None:
                    return None
                shares[stream.message_id] = min(1.0, stream.came_hz / stream.want.rate_hz)
        return shares

    def take_window(self, ids: tuple[int, ...]) -> float | None:
        """Rate of a quantity in a window that has ended since the last call; None without one."""
        for stream in self._streams:
            if stream.want.ids == ids and stream.is_new:
                stream.is_new = False
                return stream.came_hz
        return None

    def due(self, now_ns: int) -> tuple[int, float] | None:
        """A message to be requested now, and its rate; call `asked` afterwards."""
        for stream in self._streams:
            if stream.begun_ns is not None and now_ns - stream.begun_ns >= CHECK_NS:
                self._judge(stream, now_ns)
            if now_ns >= stream.due_ns:
                return stream.message_id, stream.want.rate_hz
        return None

    def asked(self, message_id: int, refused: bool, now_ns: int) -> None:
        """A request was sent, and refused for good or not."""
        for stream in self._streams:
            if stream.message_id != message_id:
                continue
            if stream.want.rate_hz == 0:
                self._streams.remove(stream)
                return
            stream.begun_ns, stream.n = now_ns, 0
            stream.due_ns = NEVER_NS  # until it is judged
            if refused:
                self._refused(stream, now_ns)

    def skip(self, now_ns: int) -> None:
        """Ignore rates measured until now: the autopilot was silent."""
        for stream in self._streams:
            if stream.begun_ns is not None:
                stream.begun_ns, stream.n = now_ns, 0

    def _judge(self, stream: _Stream, now_ns: int) -> None:
        assert stream.begun_ns is not None
        rate_hz = stream.n / ((now_ns - stream.begun_ns) * 1e-9)
        stream.begun_ns, stream.n = now_ns, 0
        stream.came_hz, stream.is_new = rate_hz, True
        if rate_hz >= SHORT * stream.want.rate_hz or stream.message_id in self.missing:
            stream.again_ns, stream.due_ns = FIRST_AGAIN_NS, NEVER_NS
        elif stream.due_ns == NEVER_NS:
            if not stream.want.always:
                stream.again_ns = max(stream.again_ns, 3 * FIRST_AGAIN_NS)
            stream.due_ns = now_ns + stream.again_ns - FIRST_AGAIN_NS
            stream.again_ns = min(2 * stream.again_ns, MOST_AGAIN_NS)

    def _refused(self, stream: _Stream, now_ns: int) -> None:
        if stream.message_id not in self.missing:
            self.missing.append(stream.message_id)
        if stream.choice + 1 < len(stream.want.ids):
            stream.choice += 1
            stream.due_ns, stream.begun_ns = now_ns, None
