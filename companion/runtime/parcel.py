"""Parcels: messages between processes, whose large arrays are written once and read where they lie.

A message is pickled with its arrays apart (PEP 574). A small one travels whole. A large one is
written into a file in memory without a name (memfd_create(2)), and only its descriptor travels:
passing it on copies nothing and opens nothing. The memory is freed with the last process
that holds it, however that one ends; nothing is overwritten, so that no reader comes too late.
Readers map it privately: what one writes into its arrays no other sees.

A mapping keeps its whole message, and a descriptor: who keeps an array for long copies it.
"""

from __future__ import annotations

import io
import mmap
import os
import pickle
import resource
import socket
import struct
from collections.abc import Callable, Sequence
from dataclasses import fields
from operator import attrgetter
from typing import Any

import numpy as np

from companion.flight_notes import GateStep, LinkBytes
from companion.geometry.transforms import Pose
from companion.messages import Frame, FrameTracked, Odometry, Track, TrackRefined
from companion.telemetry import TELEMETRY

INLINE_BYTES = 32 << 10
"""Larger messages are shared; below, mapping costs more than a copy. A packet of those together and
their headers fits into a socket's buffer, of 208 KiB in Linux, several times."""
APART_BYTES = 4 << 10
"""Smaller arrays are pickled with the rest: the mappings of a map hold thousands."""
ALIGNMENT = 64
"""Alignment of arrays, for vector instructions."""
MOST_BYTES = 2 * INLINE_BYTES
"""Largest packet."""
_HEADER = struct.Struct("<qQB")
_LENGTH = struct.Struct("<Q")
_DESCRIPTOR = struct.Struct("i")
_ALONE = struct.Struct(f"<QQ{ALIGNMENT - 16}x")
"""Head of a message without parts apart: how many parts, their length, padding."""


def _array_parts(array: np.ndarray[Any, Any]) -> Any:
    """Parts of an array for the pickler: of small ones in half the time that numpy's own take."""
    small = array.nbytes < APART_BYTES and array.flags.c_contiguous
    if small and array.dtype.isbuiltin == 1 and not array.dtype.hasobject:
        return np.ndarray, (array.shape, array.dtype.char, bytearray(array))
    return array.__reduce_ex__(pickle.HIGHEST_PROTOCOL)


def _note_parts(note: Any) -> Any:
    """Parts of a small message for the pickler: those that it is made of, and no list of fields."""
    kind = type(note)
    return kind, _VALUES_OF[kind](note)


_NOTES: tuple[type, ...] = (
    *TELEMETRY, LinkBytes, GateStep, Odometry, Frame, FrameTracked, Track, TrackRefined, Pose,
)  # fmt: skip
"""Messages that come many times a second, and their poses."""
_VALUES_OF = {kind: attrgetter(*(each.name for each in fields(kind))) for kind in _NOTES}


_PARTS_OF: dict[type, Callable[[Any], Any]] = {
    np.ndarray: _array_parts, **dict.fromkeys(_NOTES, _note_parts),
}  # fmt: skip


class _Memory:
    """Descriptor of a file in memory; closed with its last reference."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor

    def __del__(self) -> None:
        os.close(self.descriptor)


class Parcel:
    """A closed message: the name of its class, its time, its size in memory."""

    __slots__ = ("_inline", "_memory", "kind", "n_bytes", "t_ns")

    def __init__(
        self, kind: str, t_ns: int, n_bytes: int, inline: bytearray, memory: _Memory | None
    ) -> None:
        self.kind, self.t_ns, self.n_bytes = kind, t_ns, n_bytes
        self._inline, self._memory = inline, memory

    @classmethod
    def of(cls, message: Any) -> Parcel:
        """Close a message; one without a time has 0."""
        buffers: list[memoryview] = []

        def keep(buffer: pickle.PickleBuffer) -> bool:
            raw = buffer.raw()
            if raw.nbytes < APART_BYTES:
                return True  # pickled with the rest
            buffers.append(raw)
            return False

        file = io.BytesIO()
        pickler = pickle.Pickler(file, pickle.HIGHEST_PROTOCOL, buffer_callback=keep)
        pickler.dispatch_table = _PARTS_OF
        pickler.dump(message)
        pickled = file.getbuffer()
        kind, t_ns = type(message).__name__, getattr(message, "t_ns", 0)
        if not buffers and _ALONE.size + len(pickled) <= INLINE_BYTES:  # most of all
            inline = bytearray(_ALONE.pack(1, len(pickled))) + pickled
            return cls(kind, t_ns, len(inline), inline, None)
        lengths = [len(pickled), *(each.nbytes for each in buffers)]
        head = b"".join(map(_LENGTH.pack, [len(lengths), *lengths]))
        parts, n_bytes = [memoryview(head)], len(head)
        for part in (pickled, *buffers):
            padding = -n_bytes % ALIGNMENT
            parts += [memoryview(bytes(padding)), part]
            n_bytes += padding + part.nbytes
        if n_bytes <= INLINE_BYTES:
            return cls(kind, t_ns, n_bytes, bytearray().join(parts), None)
        memory = _Memory(os.memfd_create(kind, os.MFD_CLOEXEC))
        _write(memory.descriptor, parts)
        return cls(kind, t_ns, n_bytes, bytearray(), memory)

    @property
    def is_shared(self) -> bool:
        """True if it lies in memory of its own, of which only a descriptor travels."""
        return self._memory is not None

    def open(self) -> Any:
        """The message. Its arrays may be written to, by this reader alone."""
        if self._memory is None:
            whole = memoryview(self._inline)
        else:
            whole = memoryview(
                mmap.mmap(
                    self._memory.descriptor, self.n_bytes, mmap.MAP_PRIVATE,
                    mmap.PROT_READ | mmap.PROT_WRITE,
                )
            )  # fmt: skip
        (n,) = _LENGTH.unpack_from(whole)
        lengths = struct.unpack_from(f"<{n}Q", whole, _LENGTH.size)
        at, parts = _LENGTH.size * (n + 1), []
        for length in lengths:
            at += -at % ALIGNMENT
            parts.append(whole[at : at + length])
            at += length
        return pickle.loads(parts[0], buffers=parts[1:])

    def send(self, to: socket.socket, flags: int = 0) -> None:
        """Send through a socket of packets; waits for room in it, unless the flags say not to.

        OSError where nobody reads, BlockingIOError where there is no room. Not by socket.send_fds,
        which ignores flags and so waited for a stage that was stopped.
        """
        with_it = []
        if self._memory is not None:
            descriptor = _DESCRIPTOR.pack(self._memory.descriptor)
            with_it = [(socket.SOL_SOCKET, socket.SCM_RIGHTS, descriptor)]
        to.sendmsg(self._packet(), with_it, flags)

    @classmethod
    def send_together(cls, parcels: Sequence[Parcel], to: socket.socket) -> None:
        """As `send`: one that is shared, or others of INLINE_BYTES together in one packet."""
        if len(parcels) == 1:
            parcels[0].send(to)
        else:
            to.send(b"".join(part for parcel in parcels for part in parcel._packet()))

    def _packet(self) -> list[bytes | bytearray]:
        kind = self.kind.encode()
        return [_HEADER.pack(self.t_ns, self.n_bytes, len(kind)), kind, self._inline]

    @classmethod
    def receive(cls, source: socket.socket) -> list[Parcel]:
        """Wait for the next packet; its parcels. EOFError where nobody sends any more."""
        try:
            packet, descriptors, _flags, _address = socket.recv_fds(source, MOST_BYTES, 1)
        except ConnectionResetError:
            # the other end has closed with something unread; what it sent before still waits here
            packet, descriptors, _flags, _address = socket.recv_fds(source, MOST_BYTES, 1)
        if not packet:
            raise EOFError
        memory = _Memory(descriptors[0]) if descriptors else None
        parcels, at = [], 0
        while at < len(packet):
            t_ns, n_bytes, n_kind = _HEADER.unpack_from(packet, at)
            begin = at + _HEADER.size + n_kind
            kind = packet[at + _HEADER.size : begin].decode()
            at = begin + (n_bytes if memory is None else 0)
            parcels.append(cls(kind, t_ns, n_bytes, bytearray(packet[begin:at]), memory))
        return parcels


def allow_descriptors() -> None:
    """Raise this process's limit, and its children's: each large message that waits holds one."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


def _write(descriptor: int, parts: list[memoryview]) -> None:
    for part in parts:
        left = part
        while left:  # one call writes 2 GiB at most
            left = left[os.write(descriptor, left) :]
