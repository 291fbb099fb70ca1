"""Packet framing: finds MAVLink packets in a byte stream, whose checksums it validates once.

`decode` makes messages of them: of numbers, as nearly all of an autopilot's are, by the tables of
pymavlink; of text by its codec.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pymavlink.generator.mavcrc import x25crc

V1, V2 = 0xFE, 0xFD
SIGNED = 1
SIGNATURE_SIZE = 13
LONGEST = 280
MARKER = re.compile(b"[\xfd\xfe]")
STALE_NS = 100_000_000
"""Longest pause within a packet; after it another one may begin."""
SURE_OF_EXTRA = 2
MOST_LEARNED = 4096

EXTRA_OF: dict[int, bytes] = {
    message_id: bytes([kind.crc_extra]) for message_id, kind in mavlink.mavlink_map.items()
}


def _crc_step(index: int) -> int:
    index = (index ^ (index << 4)) & 0xFF
    return ((index << 8) ^ (index << 3) ^ (index >> 4)) & 0xFFFF


LAST_BYTE_OF = {_crc_step(index): index for index in range(256)}
"""Inverse of the last step of a CRC-16/MCRF4XX: from its change to the last byte."""


class Packet(NamedTuple):
    """One packet as it was on the wire, with its header's fields."""

    raw: bytes
    system: int
    component: int
    message_id: int
    seq: int
    known: bool
    """True if the message is in this program's dialect."""

    @property
    def signed(self) -> bool:
        """True if it has a signature, valid or not."""
        return self.raw[0] == V2 and bool(self.raw[2] & SIGNED)

    @property
    def payload(self) -> bytes:
        """Bytes between header and checksum; MAVLink 2 leaves out zeros at their end."""
        begin = 10 if self.raw[0] == V2 else 6
        return self.raw[begin : begin + self.raw[1]]

    @property
    def target(self) -> tuple[int, int] | None:
        """Target system and component, 0 for any; None where the message has none."""
        places = TARGET_PLACES.get(self.message_id) if self.known else None
        if places is None:
            return None
        payload = self.payload
        system, component = (
            0 if place is None or place >= len(payload) else payload[place] for place in places
        )
        return system, component


def decode(codec: mavlink.MAVLink, packet: Packet) -> Any | None:
    """Message of a packet; None for one that our dialect cannot read."""
    if not packet.known:
        return None
    try:
        read = READERS.get(packet.message_id)
        return codec.decode(bytearray(packet.raw)) if read is None else read(packet)
    except (mavlink.MAVError, struct.error, ValueError, IndexError, TypeError):
        return None


def _reader_of(kind: type[mavlink.MAVLink_message]) -> Callable[[Packet], Any]:
    """Reader of a message of numbers: as pymavlink's, without its second look at the checksum."""
    unpack, size = kind.unpacker.unpack, kind.unpacker.size
    begins = [sum(kind.lengths[:order]) for order in kind.orders]
    counts = [kind.lengths[order] for order in kind.orders]
    places = [
        begin if count == 1 else slice(begin, begin + count)
        for begin, count in zip(begins, counts, strict=True)
    ]
    arrays = [at for at, count in enumerate(counts) if count > 1]

    def read(packet: Packet) -> Any:
        numbers = unpack(packet.payload[:size].ljust(size, b"\0"))
        values: list[Any] = [numbers[place] for place in places]
        for at in arrays:
            values[at] = list(values[at])
        message: Any = kind(*values)
        header = message.get_header()
        header.mlen, header.seq = packet.raw[1], packet.seq
        header.srcSystem, header.srcComponent = packet.system, packet.component
        message.get_msgbuf().extend(packet.raw)
        return message

    return read


READERS = {
    message_id: _reader_of(kind)
    for message_id, kind in mavlink.mavlink_map.items()
    if b"c" not in kind.native_format
}
"""Readers of messages without text, by id."""


class MavlinkStream:
    """Finds the packets in a stream of bytes.

    A packet known to the dialect is validated by its checksum. The checksum of an unknown one
    includes a number (CRC_EXTRA) that only its definition has; that number is solved for, must then
    be the same in all packets of its kind, and the first of them are accepted only directly after a
    packet.
    """

    def __init__(self) -> None:
        self.n_bad_bytes = 0
        """Bytes outside any packet."""
        self.n_breaks = 0
        """Gaps between packets."""
        self._learned: dict[int, tuple[int, int]] = {}
        self._rest = b""
        self._in_step = True
        self._last_ns = 0

    def restart(self) -> None:
        """Discard an incomplete packet: the wire was reopened."""
        self.n_bad_bytes += len(self._rest)
        self._rest = b""
        self._in_step = True

    def feed(self, data: bytes, now_ns: int) -> list[Packet]:
        """Packets that end in `data`, which came at `now_ns` by any monotonic clock."""
        if self._rest:
            if now_ns - self._last_ns > STALE_NS:
                self._in_step = False
            data = self._rest + data
        self._last_ns = now_ns
        packets: list[Packet] = []
        at, size, good, rest_from = 0, len(data), 0, -1
        while (match := MARKER.search(data, at)) is not None:
            begin = match.start()
            in_step = self._in_step and begin == at
            length = _length(data, begin)
            if length > size - begin:
                rest_from = begin if rest_from < 0 else rest_from
                if in_step:
                    break
                # in noise this length is most likely not true, and nothing need wait for it
                at = begin + 1
                self._fell_out()
                continue
            packet = self._packet(data, begin, begin + length, in_step) if length else None
            if packet is None:
                at = begin + 1
                self._fell_out()
                continue
            if begin > at:
                self._fell_out()
            packets.append(packet)
            at, rest_from = begin + length, -1
            good += length
            self._in_step = True
        else:
            if at < size and rest_from < 0:
                self._fell_out()
        end = size if rest_from < 0 else rest_from
        self._rest = data[end:]
        self.n_bad_bytes += end - good
        return packets

    def _fell_out(self) -> None:
        self.n_breaks += self._in_step
        self._in_step = False

    def _packet(self, data: bytes, begin: int, end: int, in_step: bool) -> Packet | None:
        if data[begin] == V2:
            crc_at = end - 2 - (SIGNATURE_SIZE if data[begin + 2] & SIGNED else 0)
            message_id = int.from_bytes(data[begin + 7 : begin + 10], "little")
            seq, system, component = data[begin + 4], data[begin + 5], data[begin + 6]
        else:
            crc_at = end - 2
            seq, system, component = data[begin + 2], data[begin + 3], data[begin + 4]
            message_id = data[begin + 5]
        crc = data[crc_at] | data[crc_at + 1] << 8
        extra = EXTRA_OF.get(message_id)
        if extra is not None:
            if x25crc(data[begin + 1 : crc_at] + extra).crc != crc:
                return None
        elif not self._believed(message_id, x25crc(data[begin + 1 : crc_at]).crc, crc, in_step):
            return None
        return Packet(data[begin:end], system, component, message_id, seq, extra is not None)

    def _believed(self, message_id: int, before: int, crc: int, in_step: bool) -> bool:
        index = LAST_BYTE_OF.get(crc ^ (before >> 8))
        if index is None:
            return False
        extra = index ^ (before & 0xFF)
        known, times = self._learned.get(message_id, (extra, 0))
        if times >= SURE_OF_EXTRA:
            return known == extra
        if not in_step:
            return False
        if len(self._learned) >= MOST_LEARNED:
            self._learned.clear()  # nobody has so many kinds of message
        self._learned[message_id] = (extra, times + 1 if known == extra else 1)
        return True


def _length(data: bytes, begin: int) -> int:
    """Length of a packet that would begin here; 0 if none can, more than available if unknown."""
    if len(data) - begin < 3:
        return LONGEST
    if data[begin] == V1:
        return data[begin + 1] + 8
    flags = data[begin + 2]
    if flags & ~SIGNED:  # of a MAVLink to come, which nobody may read who does not know it
        return 0
    return data[begin + 1] + 12 + (SIGNATURE_SIZE if flags & SIGNED else 0)


def _fields(message_id: int) -> Iterator[tuple[str, int]]:
    """Names of a message's fields, with their offsets in the payload."""
    kind = mavlink.mavlink_map[message_id]
    place = 0
    for name, letter, count in zip(
        kind.ordered_fieldnames, kind.native_format[1:].decode(), kind.array_lengths, strict=True
    ):
        yield name, place
        place += struct.calcsize("<" + letter) * max(1, count)


def _places_of_targets() -> dict[int, tuple[int, int | None]]:
    places = {}
    for message_id in mavlink.mavlink_map:
        fields = dict(_fields(message_id))
        if "target_system" in fields:
            places[message_id] = fields["target_system"], fields.get("target_component")
    return places


TARGET_PLACES = _places_of_targets()
