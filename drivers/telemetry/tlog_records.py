"""Packets of a .tlog: each behind eight bytes of big-endian Unix time.

pymavlink decodes single packets; the file is parsed here, so that damage costs only the packets
that it hits.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega

V1, V2 = 0xFE, 0xFD
LEAST_US, MOST_US = 946_684_800_000_000, 4_102_444_800_000_000  # the years 2000 to 2100
SIGNED = 1


@dataclass(frozen=True, slots=True)
class Record:
    """One packet with its arrival time; `begin` and `end` are its offsets in the log."""

    unix_us: int
    system: int
    component: int
    message_id: int
    begin: int
    end: int


class TlogRecords:
    """Iterates over the packets of a log; `n_damaged` bytes were skipped so far."""

    def __init__(self, log: bytes) -> None:
        self._log = log
        self._codec = ardupilotmega.MAVLink(None)
        self.n_damaged = 0

    def __iter__(self) -> Iterator[Record]:
        at, in_step = 0, True
        while (end := len(self._log)) - at > 8:
            record = self._record_at(at)
            # where the one before ended a header is believed, elsewhere only a whole packet is
            if record is not None and (
                (in_step and self._header_at(record.end)) or self._is_whole(record)
            ):
                yield record
                at, in_step = record.end, True
            else:
                in_step = False
                at += 1
                self.n_damaged += 1
        self.n_damaged += end - at

    def decode(self, record: Record) -> Any | None:
        """Message of a packet; None for a wrong checksum."""
        try:
            return self._codec.decode(bytearray(self._log[record.begin : record.end]))
        except (ardupilotmega.MAVError, struct.error, ValueError, IndexError, TypeError):
            return None

    def _is_whole(self, record: Record) -> bool:
        message = self.decode(record)
        # the codec cannot check packets of a kind that it does not know
        return message is not None and not message.get_type().startswith("UNKNOWN")

    def _header_at(self, at: int) -> bool:
        return at >= len(self._log) or self._record_at(at) is not None

    def _record_at(self, at: int) -> Record | None:
        log, begin = self._log, at + 8
        if len(log) < begin + 8:
            return None
        (unix_us,) = struct.unpack_from(">Q", log, at)
        if not LEAST_US <= unix_us <= MOST_US:
            return None
        if log[begin] == V2:
            if len(log) < begin + 12:
                return None
            end = begin + 12 + log[begin + 1] + (13 if log[begin + 2] & SIGNED else 0)
            system, component = log[begin + 5], log[begin + 6]
            message_id = int.from_bytes(log[begin + 7 : begin + 10], "little")
        elif log[begin] == V1:
            end = begin + 8 + log[begin + 1]
            system, component, message_id = log[begin + 3], log[begin + 4], log[begin + 5]
        else:
            return None
        if end > len(log):
            return None
        return Record(unix_us, system, component, message_id, begin, end)
