"""Scan of an MCAP file that may be cut short or damaged.

Records are accepted as far as they fit into the file and into each other, chunks by their checksum;
after damage the next whole chunk is searched. Only one chunk at a time is in memory.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field

from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from drivers.recording.mcap_file import (
    DAMAGED,
    FOOTER_SIZE,
    RECORD,
    ChunkPlace,
    McapFile,
    as_stream,
    records,
)
from drivers.recording.mcap_writer import MAGIC, Contents

MOST_OF_SMALL = 64 << 20
"""Size limit of an attachment or another record that is read whole."""
WINDOW = 1 << 20
# opcode, length below 4 GB, times, size, checksum, then one of the two compressions
CHUNK_BEGIN = re.compile(rb"\x06.{4}\x00{4}.{28}(?:\x04\x00{3}zstd|\x00{4})", re.DOTALL)
LONGEST_BEGIN = 45
NOTES = frozenset(
    {Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.ATTACHMENT, Opcode.METADATA}
)


@dataclass(slots=True)
class Scan:
    """Content of a file."""

    profile: str = ""
    whole: bool = False
    """True if the file has a valid end."""
    contents: Contents = field(default_factory=Contents)
    chunks: list[ChunkPlace] = field(default_factory=list)
    attachments: dict[str, bytes] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    n_lost_bytes: int = 0
    """Bytes of unreadable data."""
    n_lost_places: int = 0
    """Number of gaps between whole chunks."""
    n_cut_bytes: int = 0
    """Unreadable bytes after the last whole record, where the file was cut."""
    good_end: int = 0
    """End of the readable data."""
    n_bytes: int = 0
    """Size of the file when scanned."""


def summary(file: McapFile) -> Scan | None:
    """Content by the file's own index, quickly; None where that is invalid."""
    found = Scan()
    begin = file.end_of_data()
    if begin is None:
        return None
    try:
        block = file.bytes_at(begin, file.size)
        for kind, body in records(memoryview(block[:-FOOTER_SIZE])):
            _take_summary(found.contents, kind, body)
        _take_notes(file, found)
        found.chunks = [file.chunk_at(index.chunk_start_offset) for index in found.contents.chunks]
    except DAMAGED:
        return None
    found.whole = True
    return found


def scan(file: McapFile, on_progress: Callable[[int], None] | None = None) -> Scan:
    """Scan the whole file; `on_progress` takes the bytes done.

    Chunks with a wrong checksum are left out and counted.
    """
    found = Scan(good_end=len(MAGIC), n_bytes=file.size)
    at, in_data, lost = len(MAGIC), True, False
    while at < file.size and not found.whole:
        record = file.record_at(at)
        if record is not None and _take_record(file, found, *record):
            opcode, at = record[0], record[2]
            if opcode == Opcode.DATA_END:
                in_data = False
            elif opcode == Opcode.CHUNK:
                found.chunks[-1] = found.chunks[-1]._replace(after_loss=lost)
                in_data, lost = True, False
            if in_data:
                found.good_end = at
        else:
            chunk = _next_chunk(file, at + 1)
            if chunk is None:
                end = file.end_of_data()
                if in_data and end is not None and end > at:  # an index follows all the same
                    found.whole, in_data = True, False
                    found.n_lost_bytes += end - at
                    found.n_lost_places += 1
                break
            found.n_lost_bytes += chunk - at
            found.n_lost_places += 1
            at, lost = chunk, True
        if on_progress is not None:
            on_progress(at)
    if in_data:
        found.n_cut_bytes = file.size - found.good_end
        found.n_lost_bytes += found.n_cut_bytes
    return found


def _take_record(file: McapFile, found: Scan, opcode: int, at: int, end: int) -> bool:
    """Take a record; whether it is valid."""
    begin, contents = at + RECORD.size, found.contents
    try:
        if opcode == Opcode.CHUNK:
            _take_chunk(file, found, at)
        elif opcode == Opcode.FOOTER:
            found.whole = file.bytes_at(end, file.size) == MAGIC
            return found.whole
        elif end - begin > MOST_OF_SMALL or opcode == Opcode.MESSAGE:
            return False  # no messages outside chunks in files of ours
        elif opcode in NOTES:
            _take_small(found, opcode, at, file.bytes_at(begin, end))
        elif opcode == Opcode.MESSAGE_INDEX:
            if not contents.chunks:
                return False
            index = contents.chunks[-1]
            index.message_index_length += end - at
            (channel,) = struct.unpack("<H", file.bytes_at(begin, begin + 2))
            index.message_index_offsets[channel] = at
    except DAMAGED:
        return False
    return True


def _take_small(found: Scan, opcode: int, at: int, body: bytes) -> None:
    contents, stream = found.contents, as_stream(body)
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


def _take_chunk(file: McapFile, found: Scan, at: int) -> None:
    place = file.chunk_at(at)
    messages = file.messages(place, found.contents.channels)
    found.contents.counts.update(message.channel.id for message in messages)
    found.chunks.append(place)
    found.contents.chunks.append(
        ChunkIndex(
            place.end - at, at, place.compression, place.end - place.data_at, place.stop_ns, 0,
            {}, place.start_ns, place.size,
        )
    )  # fmt: skip


def _next_chunk(file: McapFile, at: int) -> int | None:
    """Offset of the next whole chunk."""
    while at < file.size:
        window = file.bytes_at(at, at + WINDOW)
        for match in CHUNK_BEGIN.finditer(window):
            try:
                file.content(file.chunk_at(at + match.start()))
            except DAMAGED:
                continue
            return at + match.start()
        at += max(1, len(window) - LONGEST_BEGIN)
        if len(window) < WINDOW:
            return None
    return None


def _take_notes(file: McapFile, found: Scan) -> None:
    """Header, attachments and metadata that a summary names."""
    contents = found.contents
    found.profile = file.profile()
    places = [(each.offset, each.length) for each in contents.attachments]
    places += [(each.offset, each.length) for each in contents.metadata]
    contents.attachments, contents.metadata = [], []
    for offset, length in places:
        if not RECORD.size < length <= MOST_OF_SMALL:
            raise ValueError("size of an attachment")
        record = file.bytes_at(offset, offset + length)
        _take_small(found, record[0], offset, record[RECORD.size :])


def _take_summary(contents: Contents, kind: int, body: memoryview) -> None:
    stream = as_stream(body)
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
