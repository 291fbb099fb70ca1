"""Records of an ArduPilot DataFlash log (.BIN): self-described by FMT records at its head.

pymavlink's DFFormat decodes; the file is parsed here, so that damage costs only the records that it
hits (pymavlink's own index ends at the first unknown kind).
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from typing import Any

from pymavlink.DFReader import FORMAT_TO_STRUCT, DFFormat

HEAD = b"\xa3\x95"
FMT, FMT_LENGTH = 0x80, 89
PADDING = 528
"""Bytes at the end of a log that may be old memory: no damage."""


@dataclass(slots=True)
class DataflashRecords:
    """Iterates over records of the kinds named; `n_damaged` bytes were skipped so far."""

    log: bytes
    kinds: Collection[str]
    n_damaged: int = 0
    _formats: dict[int, DFFormat] = field(default_factory=dict)

    def __iter__(self) -> Iterator[tuple[str, dict[str, Any]]]:
        self._formats = {
            FMT: DFFormat(FMT, "FMT", FMT_LENGTH, "BBnNZ", "Type,Length,Name,Format,Columns")
        }
        wanted = {FMT}
        at, size = 0, len(self.log)
        while at + 3 <= size:
            kind = self.log[at + 2]
            form = self._formats.get(kind) if self.log[at : at + 2] == HEAD else None
            end = at + form.len if form is not None else 0
            if form is None or end > size or self.log[end : end + 2] not in (HEAD, b"\xa3", b""):
                following = self.log.find(HEAD, at + 1)
                after = size if following < 0 else following
                self.n_damaged += after - at if after < size or size - at > PADDING else 0
                at = after
                continue
            if kind in wanted:
                values = _values(form, self.log[at + 3 : end])
                if values is None:
                    self.n_damaged += end - at
                elif kind == FMT:
                    self._define(values, wanted)
                else:
                    yield form.name, values
            at = end

    def _define(self, values: dict[str, Any], wanted: set[int]) -> None:
        kind, length = int(values["Type"]), int(values["Length"])
        if kind == FMT:
            return
        if not set(values["Format"]) <= FORMAT_TO_STRUCT.keys():
            self.n_damaged += FMT_LENGTH
            return
        form = DFFormat(kind, values["Name"], length, values["Format"], values["Columns"])
        size = struct.calcsize(form.msg_struct) + 3
        if size != length or len(form.columns) != len(form.msg_fmts):
            self.n_damaged += FMT_LENGTH
            return
        self._formats[kind] = form
        if form.name in self.kinds:
            wanted.add(kind)


def _values(form: DFFormat, body: bytes) -> dict[str, Any] | None:
    try:
        raw = struct.unpack(form.msg_struct, body)
    except struct.error:
        return None
    values = {}
    for name, value, multiplier in zip(form.columns, raw, form.msg_mults, strict=True):
        if isinstance(value, bytes):
            values[name] = value.split(b"\0")[0].decode("latin-1")
        else:
            values[name] = value * multiplier if multiplier else value
    return values
