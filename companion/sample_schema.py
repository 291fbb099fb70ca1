"""Schema of a kind of sample, one of `telemetry`: codec, recording topic, columns and curve follow.

A message states its `Schema`. Its fields are those of its dataclass: numbers, flags, words of an
`Enum`, and arrays, whose size is in the metadata; what may be missing is `| None`.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from enum import Enum
from types import NoneType
from typing import Any, get_args, get_type_hints

QUATERNION, VECTOR = {"size": 4}, {"size": 3}
"""Metadata of an array."""
WHERE_TRUE = {"where_true": True}
"""Metadata of a flag that came later: it is written only where it is true, so that what was
written before it is read, and written again, as ever. Such a flag is the last field."""


@dataclass(frozen=True, slots=True)
class Schema:
    """Name of a message, with its description for users of recordings."""

    name: str
    says: str
    curve: str = ""
    """Label of the viewer's curve of the first field, with its unit; "" for no curve."""


@dataclass(frozen=True, slots=True)
class Field:
    """Field of a message: an array of `size` numbers, a flag, one of the `words`, or a number."""

    name: str
    may_lack: bool = False
    size: int | None = None
    is_flag: bool = False
    where_true: bool = False
    """Of a flag: it is written only where it is true."""
    words: type[Enum] | None = None


def fields_of(message: type[Any]) -> tuple[Field, ...]:
    """Fields of a telemetry message without its time; TypeError for one that has no codec."""
    types = get_type_hints(message)
    return tuple(
        _field(message, each, types[each.name])
        for each in dataclasses.fields(message)
        if each.name != "t_ns"
    )


def _field(message: type[Any], field: dataclasses.Field[Any], kind: Any) -> Field:
    may_lack = NoneType in get_args(kind)
    if "size" in field.metadata:
        return Field(field.name, may_lack, size=field.metadata["size"])
    if kind in (float, float | None):
        return Field(field.name, may_lack)
    if kind is bool:
        return Field(field.name, is_flag=True, where_true="where_true" in field.metadata)
    if isinstance(kind, type) and issubclass(kind, Enum):
        return Field(field.name, words=kind)
    raise TypeError(f"{message.__name__}.{field.name}: no codec for {kind}")
