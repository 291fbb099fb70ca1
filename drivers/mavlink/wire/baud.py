"""Automatic baud rate of a serial line, by whether packets come."""

from __future__ import annotations

BAUDS = (921600, 57600, 115200, 460800, 230400, 1500000, 500000, 38400, 19200, 9600)
"""Rates in the order of the search: the most common first."""
SURE_PACKETS = 2
SILENT_NS = 1_200_000_000
"""An autopilot sends at least a heartbeat every second."""
HOPEFUL_NS = 2_500_000_000
GARBAGE_BYTES = 560
"""Bytes that must contain a whole packet: twice the longest."""
LOST_BYTES, LOST_NS = 2000, 3_000_000_000


class BaudSearch:
    """Tries one rate after the other until packets come, and again after lasting garbage.

    Silence tells nothing, so a silent rate is left after a while for the next; garbage tells that
    the rate is wrong. A rate that was found is kept through any silence, and tried first next time.
    """

    def __init__(self, bauds: tuple[int, ...] = BAUDS) -> None:
        self.found = False
        self.garbled = False
        """True if bytes come, but no packets."""
        self._bauds = list(bauds)
        self._at = 0
        self._since_ns = 0
        self._packet_ns = 0
        self._n_packets = 0
        self._n_noise = 0

    @property
    def baud(self) -> int:
        """Rate in use now."""
        return self._bauds[self._at]

    def begin(self, t_ns: int) -> None:
        """The line was opened; starts with the last good rate."""
        if self.found:
            self._bauds.insert(0, self._bauds.pop(self._at))
        self.found = False
        self._listen(0, t_ns)

    def heard(self, n_bytes: int, n_packets: int, t_ns: int) -> None:
        """Count bytes received at `baud`, and packets completed by them."""
        if n_packets:
            self._n_packets += n_packets
            self._packet_ns = t_ns
            self._n_noise = 0
            self.garbled = False
            self.found = self.found or self._n_packets >= SURE_PACKETS
            return
        self._n_noise += n_bytes
        quiet_ns = t_ns - max(self._packet_ns, self._since_ns)
        if self._n_noise >= LOST_BYTES and quiet_ns >= LOST_NS:
            self.garbled = True
            self.found = False

    def look(self, t_ns: int) -> bool:
        """True if another rate is due, which is then in `baud`."""
        if self.found or len(self._bauds) == 1:
            return False
        patience_ns = HOPEFUL_NS if self._n_packets else SILENT_NS
        noisy = self._n_noise >= GARBAGE_BYTES
        if not noisy and t_ns - max(self._since_ns, self._packet_ns) < patience_ns:
            return False
        self._listen((self._at + 1) % len(self._bauds), t_ns)
        return True

    def _listen(self, at: int, t_ns: int) -> None:
        self._at = at
        self._since_ns = t_ns
        self._packet_ns = 0
        self._n_packets = 0
        self._n_noise = 0
