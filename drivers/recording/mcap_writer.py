"""MCAP writer: self-contained chunks, and an index at the end.

The mcap library's own writer ends a chunk by size; here the recorder decides, so that data older
than a limit is on disk. Each chunk repeats the channels that it uses: a file whose beginning is
damaged can still be read. https://mcap.dev/spec
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC = b"\x89MCAP0\r\n"
LIBRARY = "companion"
LEVEL = 1
"""Level of zstd: the lowest, as images do not compress any further."""


@dataclass(slots=True)
class Contents:
    """Summary of a file's data, for its end."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    """Messages by channel."""

    @property
    def start_ns(self) -> int:
        """Time of the first message, 0 where there is none."""
        return min((chunk.message_start_time for chunk in self.chunks), default=0)

    @property
    def stop_ns(self) -> int:
        """Time of the last message, 0 where there is none."""
        return max((chunk.message_end_time for chunk in self.chunks), default=0)


class McapWriter:
    """One file; `append` puts bytes at its end, whole, or raises and leaves it as it was.

    Messages wait until `flush`. Where that raises they still wait, and the file is unchanged.
    """

    def __init__(self, append: Callable[[bytes], None], profile: str) -> None:
        self._append = append
        self._at = 0
        self._contents = Contents()
        self._sequences: Counter[int] = Counter()
        self._waiting: list[Message] = []
        self.n_waiting_bytes = 0
        """Size of messages that are in no chunk yet."""
        self._compressor = zstandard.ZstdCompressor(level=LEVEL, write_content_size=True)
        self._put(MAGIC + _bytes_of(Header(profile, LIBRARY)))

    @property
    def n_bytes(self) -> int:
        """Size of the file so far."""
        return self._at

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema; its id."""
        schema = Schema(len(self._contents.schemas) + 1, data, encoding, name)
        self._put(_bytes_of(schema))
        self._contents.schemas[schema.id] = schema
        return schema.id

    def channel(self, topic: str, encoding: str, schema_id: int) -> int:
        """Add a channel; its id."""
        channel = Channel(len(self._contents.channels) + 1, topic, encoding, {}, schema_id)
        self._put(_bytes_of(channel))
        self._contents.channels[channel.id] = channel
        return channel.id

    def attach(self, name: str, media_type: str, data: bytes, t_ns: int) -> None:
        """Write an attachment at once."""
        record = _bytes_of(Attachment(t_ns, t_ns, name, media_type, data))
        place = self._put(record)
        self._contents.attachments.append(
            AttachmentIndex(place, len(record), t_ns, t_ns, len(data), name, media_type)
        )

    def note(self, name: str, words: Mapping[str, str]) -> None:
        """Write metadata at once."""
        record, index = note_record(name, words, self._at)
        self._put(record)
        self._contents.metadata.append(index)

    def add(
        self, channel: int, t_ns: int, data: bytes, publish_ns: int, sequence: int | None = None
    ) -> None:
        """Add a message to the present chunk; without a `sequence` it is numbered."""
        if sequence is None:
            sequence = self._sequences[channel]
        self._sequences[channel] = sequence + 1
        self._waiting.append(Message(channel, t_ns, data, publish_ns, sequence & 0xFFFFFFFF))
        self.n_waiting_bytes += len(data)

    def flush(self) -> None:
        """Write the waiting messages as a chunk."""
        if not self._waiting:
            return
        chunk, offsets, times = self._chunk()
        record = _bytes_of(chunk)
        indexes, index_places = b"", {}
        for channel, places in offsets.items():
            index_places[channel] = self._at + len(record) + len(indexes)
            indexes += _bytes_of(MessageIndex(channel, places))
        place = self._put(record + indexes)
        self._contents.chunks.append(
            ChunkIndex(
                len(record), place, chunk.compression, len(chunk.data), max(times), len(indexes),
                index_places, min(times), chunk.uncompressed_size,
            )
        )  # fmt: skip
        for channel, places in offsets.items():
            self._contents.counts[channel] += len(places)
        self.drop_waiting()

    def drop_waiting(self) -> int:
        """Drop the waiting messages; their number."""
        n_dropped = len(self._waiting)
        self._waiting = []
        self.n_waiting_bytes = 0
        return n_dropped

    def finish(self) -> None:
        """Write the waiting messages and the index."""
        self.flush()
        self._put(ending(self._contents, self._at))

    def _chunk(self) -> tuple[Chunk, dict[int, list[tuple[int, int]]], list[int]]:
        builder = RecordBuilder()
        for channel in sorted({message.channel_id for message in self._waiting}):
            self._contents.channels[channel].write(builder)
        offsets: dict[int, list[tuple[int, int]]] = {}
        for message in self._waiting:
            offsets.setdefault(message.channel_id, []).append((message.log_time, builder.count))
            message.write(builder)
        content: bytes = builder.end()  # type: ignore[no-untyped-call]
        times = [message.log_time for message in self._waiting]
        packed = self._compressor.compress(content)
        chunk = Chunk("zstd", packed, max(times), min(times), zlib.crc32(content), len(content))
        return chunk, offsets, times

    def _put(self, data: bytes) -> int:
        self._append(data)
        place, self._at = self._at, self._at + len(data)
        return place


def ending(contents: Contents, at: int) -> bytes:
    """End of a file that is `at` bytes long: end of data, index, footer."""
    end_of_data = _bytes_of(DataEnd(0))
    summary_at = at + len(end_of_data)
    groups: list[tuple[Opcode, list[Any]]] = [
        (Opcode.SCHEMA, list(contents.schemas.values())),
        (Opcode.CHANNEL, list(contents.channels.values())),
        (Opcode.STATISTICS, [_statistics(contents)]),
        (Opcode.CHUNK_INDEX, contents.chunks),
        (Opcode.ATTACHMENT_INDEX, contents.attachments),
        (Opcode.METADATA_INDEX, contents.metadata),
    ]
    summary, offsets = b"", []
    for opcode, records in groups:
        if records:
            group = b"".join(map(_bytes_of, records))
            offsets.append(SummaryOffset(opcode, summary_at + len(summary), len(group)))
            summary += group
    offsets_at = summary_at + len(summary)
    summary += b"".join(map(_bytes_of, offsets))
    footer = _bytes_of(Footer(summary_at, offsets_at, 0))[:-4]
    crc = zlib.crc32(summary + footer)
    return end_of_data + summary + footer + crc.to_bytes(4, "little") + MAGIC


def note_record(name: str, words: Mapping[str, str], at: int) -> tuple[bytes, MetadataIndex]:
    """Metadata record for offset `at`, and its index entry."""
    record = _bytes_of(Metadata(name, dict(words)))
    return record, MetadataIndex(at, len(record), name)


def _statistics(contents: Contents) -> Statistics:
    return Statistics(
        attachment_count=len(contents.attachments), channel_count=len(contents.channels),
        channel_message_counts=dict(sorted(contents.counts.items())),
        chunk_count=len(contents.chunks), message_count=contents.counts.total(),
        metadata_count=len(contents.metadata), message_start_time=contents.start_ns,
        message_end_time=contents.stop_ns, schema_count=len(contents.schemas),
    )  # fmt: skip


def _bytes_of(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    out: bytes = builder.end()  # type: ignore[no-untyped-call]
    return out
