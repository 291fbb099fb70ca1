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


@dataclass(slots=True)
class _Stream:
    want: Wanted
    choice: int = 0
    due_ns: int = 0
    again_ns: int = FIRST_AGAIN_NS
    begun_ns: int | None = None
    """Begin of the measurement; None before the first request."""
    n: int = 0

    @property
    def message_id(self) -> int:
        return self.want.ids[self.choice]


class MessageRates:
    """State of every quantity; asks no clock and sends nothing itself."""

    def __init__(self, wants: Sequence[Wanted]) -> None:
        self._streams = [_Stream(want) for want in wants]
        self.missing: list[int] = []
        """Messages that this autopilot has reported as unsupported."""

    def restart(self) -> None:
        """Request everything anew: the autopilot has rebooted."""
        self._streams = [_Stream(stream.want) for stream in self._streams]
        self.missing = []

    def came(self, message_id: int) -> None:
        """Count a message."""
        for stream in self._streams:
            if message_id == stream.message_id:
                stream.n += 1

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
