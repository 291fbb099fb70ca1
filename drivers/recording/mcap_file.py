"""MCAP file: bytes, records and chunks, validated before use."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Footer, Header

from companion.errors import FlightError
from drivers.recording.mcap_writer import MAGIC

RECORD = struct.Struct("<BQ")
CHUNK_HEAD = struct.Struct("<QQQII")
MESSAGE_HEAD = struct.Struct("<HIQQ")
MOST_IN_CHUNK = 256 << 20
FOOTER_SIZE = 9 + 20 + len(MAGIC)
OPCODES = frozenset(map(int, Opcode))
DAMAGED = (struct.error, ValueError, McapError, RuntimeError, zstandard.ZstdError)
"""Exceptions of the libraries, and of this module, on damaged data."""


class McapMessage(NamedTuple):
    """One message; `data` is valid until the next chunk is read."""

    channel: Channel
    sequence: int
    t_ns: int
    publish_ns: int
    data: memoryview


class ChunkPlace(NamedTuple):
    """Offset of a chunk, and the fields of its header."""

    at: int
    end: int
    start_ns: int
    stop_ns: int
    size: int
    crc: int
    compression: str
    data_at: int
    after_loss: bool = False
    """True if data before it could not be read."""


class McapFile:
    """An open file; FlightError where it is no MCAP file. Close it, or use it with `with`.

    Safe on a file that grows meanwhile: later data is ignored.
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
        """Profile in the header; "" without one."""
        record = self.record_at(len(MAGIC))
        if record is None or record[0] != Opcode.HEADER:
            return ""
        try:
            body = self.bytes_at(record[1] + RECORD.size, record[2])
            return str(Header.read(as_stream(body)).profile)
        except DAMAGED:
            return ""

    def record_at(self, at: int) -> tuple[int, int, int] | None:
        """Opcode, begin and end of a record; None where none fits."""
        head = self.bytes_at(at, at + RECORD.size)
        if len(head) < RECORD.size:
            return None
        opcode, length = RECORD.unpack(head)
        end = at + RECORD.size + length
        if opcode not in OPCODES or end > self.size:
            return None
        return opcode, at, end

    def end_of_data(self) -> int | None:
        """Begin of the index that the footer names, if its checksum is right."""
        tail = self.bytes_at(self.size - FOOTER_SIZE, self.size)
        if len(tail) < FOOTER_SIZE or not tail.endswith(MAGIC):
            return None
        opcode, length = RECORD.unpack_from(tail)
        footer = Footer.read(as_stream(tail[RECORD.size :]))
        begin = footer.summary_start
        if opcode != Opcode.FOOTER or length != 20 or not 0 < begin < self.size - FOOTER_SIZE:
            return None
        if self.size - begin > MOST_IN_CHUNK:
            return None
        right = footer.summary_crc == zlib.crc32(self.bytes_at(begin, self.size - len(MAGIC) - 4))
        return begin if right or not footer.summary_crc else None

    def chunk_at(self, at: int) -> ChunkPlace:
        """Chunk that begins there, by its header; one of DAMAGED where there is none."""
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

    def content(self, chunk: ChunkPlace) -> bytes:
        """Content of a chunk; one of DAMAGED where its checksum is wrong."""
        data = self.bytes_at(chunk.data_at, chunk.end)
        if chunk.compression == "zstd":
            if zstandard.get_frame_parameters(data).content_size > chunk.size:
                raise ValueError("size of a chunk")
            data = zstandard.ZstdDecompressor().decompress(data, max_output_size=chunk.size)
        if len(data) != chunk.size or chunk.crc not in (0, zlib.crc32(data)):
            raise ValueError("checksum of a chunk")
        return data

    def messages(self, chunk: ChunkPlace, channels: dict[int, Channel]) -> list[McapMessage]:
        """All messages of a chunk whose channel is known, or defined in the chunk.

        One of DAMAGED where the chunk is damaged.
        """
        out = []
        for kind, body in records(memoryview(self.content(chunk))):
            if kind == Opcode.CHANNEL:
                channel = Channel.read(as_stream(body))
                channels.setdefault(channel.id, channel)
            elif kind == Opcode.MESSAGE:
                number, sequence, t_ns, publish_ns = MESSAGE_HEAD.unpack_from(body)
                if number in channels:
                    data = body[MESSAGE_HEAD.size :]
                    out.append(McapMessage(channels[number], sequence, t_ns, publish_ns, data))
        return out


def records(block: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Records in a block of memory; ValueError where one goes beyond its end."""
    at, size = 0, len(block)
    while at + RECORD.size <= size:
        opcode, length = RECORD.unpack_from(block, at)
        end = at + RECORD.size + length
        if end > size:
            raise ValueError("a record in a chunk")
        yield opcode, block[at + RECORD.size : end]
        at = end


def as_stream(body: bytes | memoryview) -> ReadDataStream:
    """Stream from which the mcap library reads records."""
    return ReadDataStream(BytesIO(body))
