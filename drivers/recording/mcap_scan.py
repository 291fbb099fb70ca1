"""Reads MCAP as it really is: cut short, or with bytes that are not what was written.

Records are believed as far as they fit into the file and into each other, chunks by their checksum;
where that fails the next whole chunk is looked for. Nothing is read into memory but one chunk.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from companion.errors import FlightError
from drivers.recording.mcap_writer import MAGIC, Contents

RECORD = struct.Struct("<BQ")
CHUNK_HEAD = struct.Struct("<QQQII")
MESSAGE_HEAD = struct.Struct("<HIQQ")
MOST_IN_CHUNK = 256 << 20
MOST_OF_SMALL = 64 << 20
"""Bytes of an attachment or another record that is read whole."""
WINDOW = 1 << 20
FOOTER_SIZE = 9 + 20 + len(MAGIC)
# opcode, length below 4 GB, times, size, checksum, then one of the two compressions
CHUNK_BEGIN = re.compile(rb"\x06.{4}\x00{4}.{28}(?:\x04\x00{3}zstd|\x00{4})", re.DOTALL)
LONGEST_BEGIN = 45
OPCODES = frozenset(map(int, Opcode))
NOTES = frozenset(
    {Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.ATTACHMENT, Opcode.METADATA}
)
DAMAGED = (struct.error, ValueError, McapError, RuntimeError, zstandard.ZstdError)
"""What the libraries raise on bytes that are not what they should be."""


class McapMessage(NamedTuple):
    """One message; `data` is only good until the next chunk is read."""

    channel: Channel
    sequence: int
    t_ns: int
    publish_ns: int
    data: memoryview


class ChunkPlace(NamedTuple):
    """Where a chunk lies, and what its head says of it."""

    at: int
    end: int
    start_ns: int
    stop_ns: int
    size: int
    crc: int
    compression: str
    data_at: int
    after_loss: bool = False
    """Whether something that lay before it could not be read."""


@dataclass(slots=True)
class Scan:
    """What there is in a file."""

    profile: str = ""
    whole: bool = False
    """Whether it ends as it should."""
    contents: Contents = field(default_factory=Contents)
    chunks: list[ChunkPlace] = field(default_factory=list)
    attachments: dict[str, bytes] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    n_lost_bytes: int = 0
    """Bytes of data that could not be read."""
    n_lost_places: int = 0
    """Places between whole chunks where they lay."""
    n_cut_bytes: int = 0
    """Those of them after the last whole record, where the file was cut."""
    good_end: int = 0
    """Where the data end that can be read."""


class McapFile:
    """An open file; FlightError where it is no MCAP file at all. To be closed, or used by `with`.

    Safe on a file that grows meanwhile: what came after opening is not there.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise FlightError(f"{path}: cannot be read: {error.strerror}") from error
        self.size = os.fstat(self.fd).st_size
        if self.bytes_at(0, len(MAGIC)) != MAGIC:
            self.close()
            raise FlightError(f"{path}: not an MCAP file")

    def __enter__(self) -> McapFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close it; can be called twice."""
        fd, self.fd = self.fd, -1
        if fd >= 0:
            os.close(fd)

    def bytes_at(self, begin: int, end: int) -> bytes:
        """Bytes of the file, fewer where it ends before."""
        if not 0 <= begin < self.size:
            return b""
        try:
            return os.pread(self.fd, max(0, min(end, self.size) - begin), begin)
        except OSError as error:
            raise FlightError(f"{self.path}: cannot be read: {error.strerror}") from error

    def profile(self) -> str:
        """What the header says that this is; "" where there is none."""
        head = Scan()
        record = self._record_at(len(MAGIC))
        if record is not None and record[0] == Opcode.HEADER:
            self._take_record(head, *record)
        return head.profile

    def summary(self) -> Scan | None:
        """What the file's own end says of it, quickly; None where that is not to be believed."""
        found = Scan()
        begin = self._end_of_data()
        if begin is None:
            return None
        try:
            block = self.bytes_at(begin, self.size)
            for kind, body in _records(memoryview(block[:-FOOTER_SIZE])):
                _take_summary(found.contents, kind, body)
            self._take_notes(found)
            found.chunks = [
                self._chunk_at(index.chunk_start_offset) for index in found.contents.chunks
            ]
        except DAMAGED:
            return None
        found.whole = True
        return found

    def _end_of_data(self) -> int | None:
        """Where the index begins that the footer names, if its checksum is right."""
        tail = self.bytes_at(self.size - FOOTER_SIZE, self.size)
        if len(tail) < FOOTER_SIZE or not tail.endswith(MAGIC):
            return None
        opcode, length = RECORD.unpack_from(tail)
        footer = Footer.read(_stream(tail[RECORD.size :]))
        begin = footer.summary_start
        if opcode != Opcode.FOOTER or length != 20 or not 0 < begin < self.size - FOOTER_SIZE:
            return None
        if self.size - begin > MOST_IN_CHUNK:
            return None
        right = footer.summary_crc == zlib.crc32(self.bytes_at(begin, self.size - len(MAGIC) - 4))
        return begin if right or not footer.summary_crc else None

    def scan(self, told: Callable[[int], None] | None = None) -> Scan:
        """Go through all of it; `told` hears how many bytes are done.

        Chunks whose checksum is wrong are left out and counted.
        """
        found = Scan(good_end=len(MAGIC))
        at, in_data, lost = len(MAGIC), True, False
        while at < self.size and not found.whole:
            record = self._record_at(at)
            if record is not None and self._take_record(found, *record):
                opcode, at = record[0], record[2]
                if opcode == Opcode.DATA_END:
                    in_data = False
                elif opcode == Opcode.CHUNK:
                    found.chunks[-1] = found.chunks[-1]._replace(after_loss=lost)
                    in_data, lost = True, False
                if in_data:
                    found.good_end = at
            else:
                chunk = self._next_chunk(at + 1)
                if chunk is None:
                    end = self._end_of_data()
                    if in_data and end is not None and end > at:  # an index follows all the same
                        found.whole, in_data = True, False
                        found.n_lost_bytes += end - at
                        found.n_lost_places += 1
                    break
                found.n_lost_bytes += chunk - at
                found.n_lost_places += 1
                at, lost = chunk, True
            if told is not None:
                told(at)
        if in_data:
            found.n_cut_bytes = self.size - found.good_end
            found.n_lost_bytes += found.n_cut_bytes
        return found

    def messages(self, chunk: ChunkPlace, channels: dict[int, Channel]) -> list[McapMessage]:
        """All messages of a chunk whose channel is known, or told by the chunk itself.

        One of DAMAGED where the chunk is not what was written.
        """
        out = []
        for kind, body in _records(memoryview(self._content(chunk))):
            if kind == Opcode.CHANNEL:
                channel = Channel.read(_stream(body))
                channels.setdefault(channel.id, channel)
            elif kind == Opcode.MESSAGE:
                number, sequence, t_ns, publish_ns = MESSAGE_HEAD.unpack_from(body)
                if number in channels:
                    data = body[MESSAGE_HEAD.size :]
                    out.append(McapMessage(channels[number], sequence, t_ns, publish_ns, data))
        return out

    def _record_at(self, at: int) -> tuple[int, int, int] | None:
        """Opcode, begin and end of a record; None where none fits."""
        head = self.bytes_at(at, at + RECORD.size)
        if len(head) < RECORD.size:
            return None
        opcode, length = RECORD.unpack(head)
        end = at + RECORD.size + length
        if opcode not in OPCODES or end > self.size:
            return None
        return opcode, at, end

    def _take_record(self, found: Scan, opcode: int, at: int, end: int) -> bool:
        """Take what a record says; whether it can be believed."""
        begin, contents = at + RECORD.size, found.contents
        try:
            if opcode == Opcode.CHUNK:
                self._take_chunk(found, at)
            elif opcode == Opcode.FOOTER:
                found.whole = self.bytes_at(end, self.size) == MAGIC
                return found.whole
            elif end - begin > MOST_OF_SMALL or opcode == Opcode.MESSAGE:
                return False  # no messages outside chunks in files of ours
            elif opcode in NOTES:
                self._take_small(found, opcode, at, self.bytes_at(begin, end))
            elif opcode == Opcode.MESSAGE_INDEX:
                if not contents.chunks:
                    return False
                index = contents.chunks[-1]
                index.message_index_length += end - at
                (channel,) = struct.unpack("<H", self.bytes_at(begin, begin + 2))
                index.message_index_offsets[channel] = at
        except DAMAGED:
            return False
        return True

    def _take_small(self, found: Scan, opcode: int, at: int, body: bytes) -> None:
        contents, stream = found.contents, _stream(body)
        size = RECORD.size + len(body)
        if opcode == Opcode.HEADER:
            found.profile = Header.read(stream).profile
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            contents.schemas.setdefault(schema.id, schema)
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            contents.channels.setdefault(channel.id, channel)
        elif opcode == Opcode.METADATA:
            words = Metadata.read(stream)
            found.metadata[words.name] = words.metadata
            contents.metadata.append(MetadataIndex(at, size, words.name))
        else:
            each = Attachment.read(stream)
            if int.from_bytes(body[-4:], "little") not in (0, zlib.crc32(body[:-4])):
                raise ValueError("checksum of an attachment")
            found.attachments[each.name] = each.data
            contents.attachments.append(
                AttachmentIndex(
                    at, size, each.log_time, each.create_time, len(each.data), each.name,
                    each.media_type,
                )
            )  # fmt: skip

    def _take_chunk(self, found: Scan, at: int) -> None:
        place = self._chunk_at(at)
        messages = self.messages(place, found.contents.channels)
        found.contents.counts.update(message.channel.id for message in messages)
        found.chunks.append(place)
        found.contents.chunks.append(
            ChunkIndex(
                place.end - at, at, place.compression, place.end - place.data_at, place.stop_ns, 0,
                {}, place.start_ns, place.size,
            )
        )  # fmt: skip

    def _chunk_at(self, at: int) -> ChunkPlace:
        head = self.bytes_at(at, at + RECORD.size + CHUNK_HEAD.size + 16)
        opcode, length = RECORD.unpack_from(head)
        start_ns, stop_ns, size, crc, n_name = CHUNK_HEAD.unpack_from(head, RECORD.size)
        name_at = RECORD.size + CHUNK_HEAD.size
        compression = head[name_at : name_at + n_name]
        (n_data,) = struct.unpack_from("<Q", head, name_at + n_name)
        data_at, end = at + name_at + n_name + 8, at + RECORD.size + length
        if (
            opcode != Opcode.CHUNK or compression not in (b"zstd", b"")
            or data_at + n_data != end or end > self.size or max(size, n_data) > MOST_IN_CHUNK
        ):  # fmt: skip
            raise ValueError("head of a chunk")
        return ChunkPlace(at, end, start_ns, stop_ns, size, crc, compression.decode(), data_at)

    def _content(self, chunk: ChunkPlace) -> bytes:
        data = self.bytes_at(chunk.data_at, chunk.end)
        if chunk.compression == "zstd":
            if zstandard.get_frame_parameters(data).content_size > chunk.size:
                raise ValueError("size of a chunk")
            data = zstandard.ZstdDecompressor().decompress(data, max_output_size=chunk.size)
        if len(data) != chunk.size or chunk.crc not in (0, zlib.crc32(data)):
            raise ValueError("checksum of a chunk")
        return data

    def _next_chunk(self, at: int) -> int | None:
        """Where the next chunk begins that is whole."""
        while at < self.size:
            window = self.bytes_at(at, at + WINDOW)
            for match in CHUNK_BEGIN.finditer(window):
                try:
                    self._content(self._chunk_at(at + match.start()))
                except DAMAGED:
                    continue
                return at + match.start()
            at += max(1, len(window) - LONGEST_BEGIN)
            if len(window) < WINDOW:
                return None
        return None

    def _take_notes(self, found: Scan) -> None:
        """Header, attachments and metadata that a summary names."""
        contents = found.contents
        found.profile = self.profile()
        places = [(each.offset, each.length) for each in contents.attachments]
        places += [(each.offset, each.length) for each in contents.metadata]
        contents.attachments, contents.metadata = [], []
        for offset, length in places:
            if not RECORD.size < length <= MOST_OF_SMALL:
                raise ValueError("size of an attachment")
            record = self.bytes_at(offset, offset + length)
            self._take_small(found, record[0], offset, record[RECORD.size :])


def _take_summary(contents: Contents, kind: int, body: memoryview) -> None:
    stream = _stream(body)
    if kind == Opcode.SCHEMA:
        schema = Schema.read(stream)
        contents.schemas[schema.id] = schema
    elif kind == Opcode.CHANNEL:
        channel = Channel.read(stream)
        contents.channels[channel.id] = channel
    elif kind == Opcode.CHUNK_INDEX:
        contents.chunks.append(ChunkIndex.read(stream))
    elif kind == Opcode.STATISTICS:
        contents.counts.update(Statistics.read(stream).channel_message_counts)
    elif kind == Opcode.ATTACHMENT_INDEX:
        contents.attachments.append(AttachmentIndex.read(stream))
    elif kind == Opcode.METADATA_INDEX:
        contents.metadata.append(MetadataIndex.read(stream))


def _records(block: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Records in a block of memory; ValueError where one goes beyond its end."""
    at, size = 0, len(block)
    while at + RECORD.size <= size:
        opcode, length = RECORD.unpack_from(block, at)
        end = at + RECORD.size + length
        if end > size:
            raise ValueError("a record in a chunk")
        yield opcode, block[at + RECORD.size : end]
        at = end


def _stream(body: bytes | memoryview) -> ReadDataStream:
    return ReadDataStream(BytesIO(body))
